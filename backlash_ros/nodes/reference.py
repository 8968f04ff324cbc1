"""Node that publishes the reference y_m."""

from __future__ import annotations

import sys
import time
from math import inf

from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_reference
from backlash_ros.core.parameter_table import REFERENCE
from backlash_ros.nodes.driver_io import DriverIo, Output
from backlash_ros.nodes.events import emit
from backlash_ros.nodes.messages import DEPTH, KEPT, arrival_ns, stamp_ns_of
from backlash_ros.nodes.prompt_executor import PromptExecutor
from backlash_ros.nodes.sample_counter import SampleCounter
from backlash_ros.nodes.spin import ProcessNode, run

# plant_output counts as silent after this; then the own clock takes over.
SILENT_PERIODS, SHORTEST_SILENCE_S = 3.0, 0.1
LONGEST_SLEEP_S = 0.05  # so that the end of the process is noticed


class ReferenceNode(ProcessNode):
    """Publishes y_m for the sample that comes next.

    plant_output is the sampling clock: with y(k), y_m of sample k+1 leaves and is there in time.
    Where no output comes, y_m goes on by the own clock; a node that waits for its subscribers
    stays at y_m(0) before the first output, so that the run begins at t = 0. In lockstep y_m
    leaves once per tick of /clock.
    """

    def __init__(self) -> None:
        super().__init__(REFERENCE)
        p = self.settings
        self._signal = build_reference(p)
        self._sample_period = p.real('sample_period')
        self._lockstep = p.flag('lockstep')
        self._started = False
        self._io = DriverIo(self, p)
        self._counter = SampleCounter(self._sample_period)
        self._sample = 0  # the one that comes next
        self._heard_at = -inf  # on the steady clock [s]
        self._message = Float64()
        self._output = self.create_publisher(
            Float64, topics.REFERENCE, KEPT if self._lockstep else DEPTH
        )
        listeners = p.integer('wait_for_subscribers')
        self._waits = listeners > 0
        self.call_when(
            lambda: self._output.get_subscription_count() >= listeners, self._start,
            f'{listeners} subscribers of {topics.REFERENCE}',
        )

    def work(self, executor: PromptExecutor) -> None:
        while not (self._started or self.stopping):
            executor.spin_once()
        if self._lockstep:
            super().work(executor)
        else:
            self._follow(executor)

    def _follow(self, executor: PromptExecutor) -> None:
        """Publish y_m half a period after each output, by the own clock where none comes.

        In between the process sleeps: woken by each output it would take the processor from the
        controller, which has to answer it.
        """
        period = self._sample_period
        silence = max(SILENT_PERIODS * period, SHORTEST_SILENCE_S)
        due = time.monotonic()
        while not self.stopping:
            remaining = due - time.monotonic()
            if remaining > 0.0:
                time.sleep(min(remaining, LONGEST_SLEEP_S))
                continue
            executor.spin_once(timeout_sec=0.0)  # the newest output
            self._publish(self._sample)
            now = time.monotonic()
            if now <= self._heard_at + silence:
                due = max(self._heard_at + 1.5 * period, now)
            else:
                due = max(due + period, now)
                if self._counter.index >= 0 or not self._waits:
                    self._sample += 1

    def _start(self) -> None:
        self._started = True
        if self._lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT)
        else:
            self._io.listen(self._on_output, depth=1)
        emit('ready')

    def _on_clock(self, message: Clock) -> None:
        self._publish(round(stamp_ns_of(message) * 1e-9 / self._sample_period))

    def _on_output(self, output: Output) -> None:
        before = self._counter.index
        if not self._counter.count(output.stamp_ns, output.sequence).is_sample:
            return
        if before < 0 and self._waits:
            self._sample = self._counter.index + 1
        else:
            self._sample += self._counter.index - before if before >= 0 else 1
        self._heard_at = arrival_ns(output.received_ns) * 1e-9

    def _publish(self, sample: int) -> None:
        # The same product as in a simulation in one process, so that runs agree to the last bit.
        self._message.data = self._signal(sample * self._sample_period)
        self._output.publish(self._message)


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(REFERENCE, ReferenceNode, args)


if __name__ == '__main__':
    sys.exit(main())
