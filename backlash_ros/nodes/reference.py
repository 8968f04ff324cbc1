"""Node that publishes the reference y_m."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.loop.reference_pace import ReferencePace
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import REFERENCE_NODE
from backlash_ros.core.reference.signal import PERIODIC
from backlash_ros.core.scenario import build_reference
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.executor import Inbox, NodeExecutor
from backlash_ros.nodes.runtime.messages import (
    DEPTH,
    KEPT_QOS,
    arrival_ns,
    message_with,
    stamp_ns_of,
)
from backlash_ros.nodes.runtime.parameters import let_parameters_change
from backlash_ros.nodes.runtime.process import ProcessNode, emit, run

LONGEST_SLEEP_S = 0.05  # so that signals and requests are noticed
# The loop runs so long, as the controller tells, before outputs that do not come here are given up.
UNHEARD_S = 0.5


class ReferenceNode(ProcessNode):
    """Publishes y_m for the sample that comes next.

    plant_output is the sampling clock, see ReferencePace; a node that waits for its subscribers
    stays at y_m(0) before the first output, so that the run begins at t = 0. In lockstep y_m
    leaves once per tick of /clock.
    """

    def __init__(self) -> None:
        super().__init__(REFERENCE_NODE)
        p = self.settings
        self._signal = build_reference(p)
        self._offset_s = 0.0  # keeps the phase where the frequency changes
        self._newest = 0  # sample that was published last
        self._sample_period = p.sample_period
        self._started = False
        self._io = DriverIo(self, p)
        self._counter = SampleCounter(self._sample_period)
        self._diagnostics: Inbox | None = None  # while no output was heard
        self._loop_runs_at: float | None = None  # when that was seen [s]
        self._output = self.create_publisher(
            Float64, topics.REFERENCE, KEPT_QOS if self.settings.lockstep else DEPTH
        )
        listeners = p.wait_for_subscribers
        self._pace = ReferencePace(
            self._sample_period, begins_with_output=listeners > 0, now_s=time.monotonic(),
            own_clock=not self._io.simulated_time,
        )
        let_parameters_change(self, build_reference, self._take_up)
        name = self.resolve_topic_name
        self.log.info(
            f'started: {name(self._io.topics.output)} in, {name(topics.REFERENCE)} out: '
            f'{p.waveform}, sample_period {self._sample_period:g} s'
            + (f'; waits for {listeners} subscribers of {topics.REFERENCE}' if listeners else '')
        )
        self.call_when(
            lambda: self._output.get_subscription_count() >= listeners, self._start,
            f'{listeners} subscribers of {topics.REFERENCE}',
        )

    def work(self, executor: NodeExecutor) -> None:
        while not (self._started or self.stopping):
            executor.spin_once()
        if self.settings.lockstep:
            super().work(executor)
        else:
            self._follow(executor)

    def _follow(self, executor: NodeExecutor) -> None:
        """Publish y_m half a period after each output, by the own clock where none comes.

        In between the process sleeps: woken by each output it would take the processor from the
        controller, which has to answer it.
        """
        pace = self._pace
        while not self.stopping:
            now = time.monotonic()
            if self._diagnostics is not None:
                self._look_for_loop(self._diagnostics, now)
            remaining = max(pace.look_s(now) - now, 0.0)
            if not pace.listens(now):
                if remaining < LONGEST_SLEEP_S:
                    time.sleep(remaining)
                else:
                    executor.spin_once(timeout_sec=LONGEST_SLEEP_S)
                continue
            executor.spin_once(timeout_sec=0.0)  # the newest output
            now = time.monotonic()
            sample = pace.sample_to_send(now)
            if sample is not None:
                self._publish(sample)
            elif pace.listens(now):
                # It is late, and y_m leaves as soon as it is there.
                executor.spin_once(timeout_sec=min(remaining, LONGEST_SLEEP_S))

    def _look_for_loop(self, diagnostics: Inbox, now: float) -> None:
        """Go by the own clock where the loop runs and its outputs do not come here.

        Fast DDS may miss a process of another machine for good that starts at the same moment.
        """
        if self._pace.waits:
            if any(self._tells_of_samples(message) for message, _ in diagnostics.take_all()):
                self._loop_runs_at = self._loop_runs_at or now
            if self._loop_runs_at is None or now < self._loop_runs_at + UNHEARD_S:
                return
            self._pace.wait_no_longer()
            self.log.warning(
                f'{self._io.topics.output} is not heard here, but by the controller: y_m goes by '
                'the own clock; start the driver some seconds before'
            )
        diagnostics.close()
        self._diagnostics = None

    def _tells_of_samples(self, message: DiagnosticArray) -> bool:
        """Whether the controller of this loop has used any."""
        loop = self.settings.io.joint or self.resolve_topic_name(self._io.topics.control)
        return any(
            value.key == 'samples' and value.value != '0'
            for status in message.status if status.hardware_id == loop for value in status.values
        )

    def _take_up(self, before: Parameters) -> None:
        """Use another signal from the next sample on; a sine goes on without a jump."""
        self._signal = build_reference(self.settings)
        if self._signal.waveform in PERIODIC:
            t = self._newest * self._sample_period
            phase = before.frequency * (t + self._offset_s)
            self._offset_s = phase / self._signal.frequency - t
        else:
            self._offset_s = 0.0

    def _start(self) -> None:
        self._started = True
        if self.settings.lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT_QOS)
        else:
            self._io.listen(self._on_output, depth=1)
            if self._pace.waits:
                self._diagnostics = Inbox(self, DiagnosticArray, topics.DIAGNOSTICS, 10)
        emit('ready')

    def _on_clock(self, message: Clock) -> None:
        self._publish(round(stamp_ns_of(message) * 1e-9 / self._sample_period))

    def _on_output(self, outputs: Mapping[str, Output]) -> None:
        output = next(iter(outputs.values()))
        if self._counter.count(
            output.stamp_ns, output.sequence, output.numbered
        ).is_sample:
            self._pace.hear(self._counter.index, arrival_ns(output.received_ns) * 1e-9)

    def _publish(self, sample: int) -> None:
        # The same product as in a simulation in one process, so that runs agree to the last bit.
        self._newest = sample
        y_m = self._signal(sample * self._sample_period + self._offset_s)
        self._output.publish(message_with(y_m))


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(REFERENCE_NODE, ReferenceNode, args)


if __name__ == '__main__':
    sys.exit(main())
