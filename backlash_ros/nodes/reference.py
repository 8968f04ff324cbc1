"""Node that publishes the reference y_m."""

import sys
import time
from collections.abc import Mapping
from functools import partial
from math import inf

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.loop.sample_counter import Output, ReferencePace, SampleCounter
from backlash_ros.core.parameters import REFERENCE_NODE, Parameters
from backlash_ros.core.scenario import PERIODIC, build_reference
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.executor import PromptExecutor, serve_polled
from backlash_ros.nodes.runtime.process import ProcessNode, emit, run


class ReferenceNode(ProcessNode):
    """Publishes y_m for the next sample, after plant_output, when ReferencePace says so.

    If it waits for its subscribers, it stays at y_m(0) until the first output. In lockstep it sends
    y_m once per tick of /clock.
    """

    def __init__(self) -> None:
        super().__init__(REFERENCE_NODE)
        p = self.settings
        self._signal = build_reference(p)
        self._offset_s = 0.0  # keeps the phase when the frequency changes
        self._newest = 0  # sample that was published last
        self._loop_runs_at = inf  # when /diagnostics first said that the loop runs [s]
        self._io = DriverIo(self)
        self._output = self.create_publisher(
            Float64, topics.REFERENCE, messages.KEPT_QOS if p.lockstep else messages.DEPTH
        )
        name = self.resolve_topic_name
        self.log.info(f'started: {name(self._io.topics.output)} in, {name(topics.REFERENCE)} out: '
                      f'{p.waveform}, sample_period {p.sample_period:g} s')

    def work(self, executor: PromptExecutor) -> None:
        p, wanted = self.settings, self.settings.wait_for_subscribers
        if self.wait_until(executor, lambda: self._output.get_subscription_count() >= wanted,
                           f'{wanted} subscribers of {topics.REFERENCE}'):
            if p.lockstep:
                self.listen_to_clock(
                    lambda time_ns: self._publish(round(time_ns * 1e-9 / p.sample_period)),
                    messages.KEPT_QOS,
                )
            emit('ready')
            if not p.lockstep:
                self._follow(executor)
        super().work(executor)

    def _follow(self, executor: PromptExecutor) -> None:
        """Publish y_m half a period after each output, or by its own clock if none comes.

        Outputs are polled: woken by each, the process would take the processor from the controller.
        """
        p, now = self.settings, time.monotonic()
        counter = SampleCounter(p.sample_period)
        pace = ReferencePace(
            p.sample_period, waits=p.wait_for_subscribers > 0, now_s=now,
            own_clock=not self._io.simulated_time,
        )

        def hear(joints: Mapping[str, Output]) -> None:
            output = next(iter(joints.values()))
            if counter.count(output.stamp_ns, output.sequence, output.numbered).is_sample:
                pace.hear(counter.index, self._io.arrival_ns(output) * 1e-9)

        outputs = self._io.listen(hear, depth=1, polled=True)
        diagnostics = self.listen_to_diagnostics(self._hear_diagnostics)
        while not self.stopping:
            if pace.waits:
                serve_polled(diagnostics)
                # Fast DDS may never discover a process of another machine that starts at the same
                # moment.
                if now > self._loop_runs_at + 0.5:
                    pace.waits = False
                    self.log.warning(
                        f'{self._io.topics.output} is not heard here, but by the controller: y_m '
                        'follows its own clock; start the driver some seconds before'
                    )
            if now >= pace.due_s:
                serve_polled(outputs)
                now = time.monotonic()
                sample = pace.sample_to_send(now)
                if sample is not None:
                    self._publish(sample)
            # A late output is looked for often, so that y_m is sent as soon as it has come.
            wake_at = pace.due_s if now < pace.due_s else now + 0.05 * p.sample_period
            executor.spin_once(timeout_sec=max(wake_at - now, 0.0))
            now = time.monotonic()

    def _hear_diagnostics(
        self, status: DiagnosticStatus, values: Mapping[str, str], received_ns: int,
    ) -> None:
        """Note when the controller of this loop has used samples."""
        loop = self.settings.io.joint or self.resolve_topic_name(self._io.topics.control)
        if status.hardware_id == loop and values.get('samples', '0') != '0':
            self._loop_runs_at = min(self._loop_runs_at, time.monotonic())

    def check_change(self, p: Parameters) -> None:
        build_reference(p)

    def take_up(self, before: Parameters) -> None:
        """Use the new signal from the next sample on; a periodic one keeps its phase."""
        self._signal = build_reference(self.settings)
        t, self._offset_s = self._newest * before.sample_period + self._offset_s, 0.0
        if self._signal.waveform in PERIODIC:
            phase = before.frequency * t
            self._offset_s = phase / self._signal.frequency - self._newest * before.sample_period

    def _publish(self, sample: int) -> None:
        # Computed as in a simulation in one process, so that runs agree to the last bit.
        self._newest = sample
        y_m = self._signal(sample * self.settings.sample_period + self._offset_s)
        self._output.publish(messages.message_with(y_m))


main = partial(run, REFERENCE_NODE, ReferenceNode)

if __name__ == '__main__':
    sys.exit(main())
