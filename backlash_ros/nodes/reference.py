"""Node that publishes the reference y_m."""

from __future__ import annotations

import sys

from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_reference
from backlash_ros.core.parameter_table import REFERENCE
from backlash_ros.nodes.events import emit
from backlash_ros.nodes.messages import DEPTH, KEPT, stamp_ns_of
from backlash_ros.nodes.reference_file import read_reference_file
from backlash_ros.nodes.spin import ProcessNode, run, spin_paced


class ReferenceNode(ProcessNode):
    """Publishes y_m(kT) every sample period; in lockstep once per tick of /clock."""

    def __init__(self) -> None:
        super().__init__(REFERENCE)
        p = self.settings
        self._signal = build_reference(p, read_reference_file(p))
        self._sample_period = p.real('sample_period')
        self._lockstep = p.flag('lockstep')
        self._started = False
        self._message = Float64()
        self._output = self.create_publisher(
            Float64, topics.REFERENCE, KEPT if self._lockstep else DEPTH
        )
        listeners = p.integer('wait_for_subscribers')
        self.call_when(
            lambda: self._output.get_subscription_count() >= listeners, self._start,
            f'{listeners} subscribers of {topics.REFERENCE}',
        )

    def work(self, executor: SingleThreadedExecutor) -> None:
        while not (self._started or self.stopping):
            executor.spin_once()
        if self._lockstep:
            super().work(executor)
        else:
            spin_paced(self, executor, self._sample_period, self._on_tick, lambda: True)

    def _start(self) -> None:
        self._started = True
        if self._lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT)
        emit('ready')

    def _on_clock(self, message: Clock) -> None:
        self._publish(round(stamp_ns_of(message) * 1e-9 / self._sample_period))

    def _on_tick(self, tick: int, due_ns: int) -> bool:
        self._publish(tick)
        return True

    def _publish(self, sample: int) -> None:
        # The same product as in a simulation in one process, so that runs agree to the last bit.
        self._message.data = self._signal(sample * self._sample_period)
        self._output.publish(self._message)


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(REFERENCE, ReferenceNode, args)


if __name__ == '__main__':
    sys.exit(main())
