"""Node that learns the backlash and cancels it: plant_output and reference in, control out."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from math import isfinite, nan
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller, build_limits, warnings_of
from backlash_ros.core.controller import ControlStep, plausible
from backlash_ros.core.estimator import Status
from backlash_ros.core.lms import NormalisedLms
from backlash_ros.core.parameter_table import CONTROLLER
from backlash_ros.core.parameters import Parameters
from backlash_ros.nodes.command_history import CommandHistory
from backlash_ros.nodes.declare import LiveParameters
from backlash_ros.nodes.events import emit
from backlash_ros.nodes.loop_statistics import LoopStatistics
from backlash_ros.nodes.messages import (
    DEPTH,
    KEPT,
    DiagnosticsPublisher,
    LabelledArrayPublisher,
    stamp_ns_of,
)
from backlash_ros.nodes.sample_counter import SampleCounter
from backlash_ros.nodes.spin import ProcessNode, run

DIAGNOSTICS_PERIOD_S = 1.0
# A controller that was held up for a few samples still learns from them; after a longer stall it
# goes on with the newest ones.
KEPT_OUTPUTS = 10
# After the command the controller gives way for this share of a period: a busy processor is where
# the driver, woken by the command, would have to wait.
GIVE_WAY = 0.05
LOOK_S = 0.1  # between two looks for a silent plant_output
# Gaps beyond this are not stepped over to the end: nothing is left to predict from them, and the
# command must not wait for it.
LONGEST_GAP = 1000

STATES: dict[Status, tuple[bytes, str]] = {
    Status.ACQUIRING: (DiagnosticStatus.OK, 'acquiring: the estimate still moves freely'),
    Status.TRACKING: (DiagnosticStatus.OK, 'tracking'),
    Status.NOT_EXCITED: (
        DiagnosticStatus.WARN, 'frozen: v did not swing past the gap lately; move it wider',
    ),
    Status.NO_DATA: (DiagnosticStatus.WARN, 'frozen: plant_output is missing'),
    Status.INCONSISTENT: (
        DiagnosticStatus.ERROR,
        'frozen: plant_output does not follow from v through G(z) and a backlash; '
        'check the sensor, G(z), whether v is applied in time, estimator.output_noise_std '
        'and estimator.bounds',
    ),
}


class ControllerNode(ProcessNode):
    """Answers every plant_output with a control; estimates and signals follow after it.

    In lockstep the k-th tick of /clock, reference and plant_output belong together, so that
    runs are repeatable; else the newest reference counts.
    """

    def __init__(self) -> None:
        super().__init__(CONTROLLER)
        p = self.settings
        period = self._sample_period = p.real('sample_period')
        self._core = build_controller(p)
        for warning in warnings_of(p, with_reference=False):
            self.log.warning(warning)
        self._lockstep = p.flag('lockstep')
        self._use_applied = p.flag('estimator.use_applied_control')
        self._counter, self._commands = SampleCounter(period), CommandHistory(period)
        self._statistics = LoopStatistics()
        self._y_m = nan  # the newest one
        self._missing = 0  # outputs since the newest one that was used
        self._last: ControlStep | None = None
        self._queues: tuple[deque[Any], deque[Any], deque[Any]] = (deque(), deque(), deque())
        self._ticks, self._references, self._outputs = self._queues
        self._timeout = 0.0 if self._lockstep else p.real('timeout.plant_output')
        self._heard_at: float | None = None  # on the steady clock [s]
        self._silent = False
        self._message = Float64()
        self._control = self.create_publisher(Float64, topics.CONTROL, DEPTH)
        self._signals = LabelledArrayPublisher(self, topics.SIGNALS, topics.SIGNAL_LABELS)
        self._estimates = LabelledArrayPublisher(self, topics.ESTIMATES, topics.ESTIMATE_LABELS)
        self._diagnostics = DiagnosticsPublisher(self)
        self._live = LiveParameters(self, p, build_controller, self._take_up)
        self._subscribe()
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=self.steady_clock)
        if self._timeout > 0.0:
            self.create_timer(LOOK_S, self._look_for_silence, clock=self.steady_clock)

    def finish(self) -> None:
        counts = self._counts()
        self.log.info(', '.join(
            f'{key}: {count}' for key, count in counts.items() if count or key == 'samples'
        ))

    def _subscribe(self) -> None:
        """Subscribe; plant_output only when everything else is there, for it starts the loop."""
        # A stalled controller goes on with the newest values; in lockstep none may be skipped.
        reference = self.create_subscription(
            Float64, topics.REFERENCE, self._on_reference, KEPT if self._lockstep else 1
        )
        if self._use_applied:
            self.listen(Float64, topics.APPLIED_CONTROL, self._on_applied_control, DEPTH)
        if self._lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT)
        needed: list[Callable[[], bool]] = []
        wanted = max(self.settings.integer('wait_for_subscribers'), int(self._lockstep))
        if wanted:
            # Beside the driver, those who listen want to hear everything.
            needed += [
                lambda: self._control.get_subscription_count() >= wanted,
                lambda: min(self._signals.listeners, self._estimates.listeners) >= wanted - 1,
            ]
            needed.append(
                (lambda: reference.get_publisher_count() > 0) if self._lockstep
                else (lambda: isfinite(self._y_m))
            )
        self.call_when(
            lambda: all(condition() for condition in needed), self._start,
            f'{topics.REFERENCE} and the listeners of {topics.CONTROL}',
        )

    def _start(self) -> None:
        self.listen(Float64, topics.PLANT_OUTPUT, self._on_output, KEPT_OUTPUTS)
        emit('ready')

    def _on_reference(self, message: Float64) -> None:
        if plausible(message.data):
            self._y_m = message.data
        else:
            self._statistics.dropped += 1
        if self._lockstep:
            self._references.append(self._y_m)
            self._pair()

    def _on_clock(self, message: Clock) -> None:
        self._ticks.append(stamp_ns_of(message))
        self._pair()

    def _on_applied_control(self, message: Float64, info: dict[str, Any]) -> None:
        if plausible(message.data):
            self._commands.report(message.data, info['source_timestamp'])
        else:
            self._statistics.dropped += 1

    def _on_output(self, message: Float64, info: dict[str, Any]) -> None:
        stamp_ns = info['source_timestamp']
        if self._lockstep:
            self._outputs.append((message.data, stamp_ns))
            self._pair()
            return
        lost = self._counter.count(stamp_ns, info['publication_sequence_number'])
        self._answer(message.data, self._y_m, stamp_ns, lost)

    def _pair(self) -> None:
        """Lockstep: answer as soon as tick, reference and output of a sample are there."""
        while all(self._queues):
            lost = self._counter.count(self._ticks.popleft())
            y, stamp_ns = self._outputs.popleft()
            self._answer(y, self._references.popleft(), stamp_ns, lost)

    def _answer(self, y: float, y_m: float, stamp_ns: int, lost: int) -> None:
        """Use y(k), which left the driver at stamp_ns, and publish v(k)."""
        statistics = self._statistics
        statistics.lost += lost
        self._missing += lost
        self._heard_at = time.monotonic()
        if not (plausible(y) and plausible(y_m)):
            if plausible(y):
                statistics.without_reference += 1
            else:
                statistics.dropped += 1
            self._missing += 1
            return
        step = self._step(y, y_m, stamp_ns)
        self._message.data = step.v
        self._control.publish(self._message)
        now_ns = time.time_ns()
        self._commands.publish(step.v, now_ns)
        if not self._lockstep:
            time.sleep(GIVE_WAY * self._sample_period)
        latency = (now_ns - stamp_ns) * 1e-9
        statistics.used += 1
        statistics.latencies.append(latency)
        self._core.refine()
        self._publish_rows(step, latency)
        changed = self._last is None or self._last.estimate.status != step.estimate.status
        self._last = step
        if changed or self._silent:
            self._note_return()
            self._diagnose()

    def _step(self, y: float, y_m: float, stamp_ns: int) -> ControlStep:
        """Step the core over the missing outputs to y, with the v that was really applied."""
        lost = min(self._missing, LONGEST_GAP)
        self._missing = 0
        if self._last is None:
            self._commands.begin(stamp_ns)
            return self._core.step(y, y_m)
        applied: list[float] = []
        if not self._lockstep:
            if self._use_applied:
                applied = self._commands.reported_over(lost + 1, stamp_ns)
            applied = applied or self._commands.over(lost + 1, stamp_ns)
        return self._core.step(y, y_m, lost, applied)

    def _take_up(self, p: Parameters) -> None:
        """Take up limits, inverse and step sizes without touching what was learned."""
        core = self._core
        core.limits = build_limits(p)
        core.inverse.direction_band = p.real('inverse.direction_band')
        core.inverse.take_up = p.real('inverse.take_up_rate') * p.real('sample_period')
        if isinstance(core.estimator, NormalisedLms):
            core.estimator.step = p.real('lms.step')
            core.estimator.step_f = p.real('lms.step_f')

    def _publish_rows(self, step: ControlStep, latency: float) -> None:
        e, sample = step.estimate, float(self._counter.index)
        estimator = self._core.estimator
        self._signals.publish((
            step.y_m, step.y, step.u_d, step.v, estimator.u_hat, estimator.innovation,
            float(e.status), sample, latency,
        ))
        self._estimates.publish((
            e.m, e.c_r, e.c_l, e.f, e.std_m, e.std_c_r, e.std_c_l, nan, sample,
        ))

    def _look_for_silence(self) -> None:
        if self._heard_at is None or self._silent:
            return
        if time.monotonic() > self._heard_at + self._timeout:
            self._silent = True
            self.log.warning(
                f'no {topics.PLANT_OUTPUT} for {self._timeout:g} s: is the driver running?'
            )
            self._diagnose()

    def _note_return(self) -> None:
        if self._silent:
            self._silent = False
            self.log.info(f'{topics.PLANT_OUTPUT} is back')

    def _diagnose(self) -> None:
        level, text = self._state()
        values: dict[str, object] = dict(self._counts())
        if self._last is not None:
            e = self._last.estimate
            values.update({
                'm': e.m, 'c_r': e.c_r, 'c_l': e.c_l, 'f': e.f,
                'std_m': e.std_m, 'std_c_r': e.std_c_r, 'std_c_l': e.std_c_l,
                'latency p50 [ms]': self._statistics.latency_ms(0.5),
                'latency p99 [ms]': self._statistics.latency_ms(0.99),
            })
        self._diagnostics.publish(level, text, values)

    def _state(self) -> tuple[bytes, str]:
        if self._silent:
            return DiagnosticStatus.WARN, f'no {topics.PLANT_OUTPUT}: is the driver running?'
        if self._last is None:
            missing = topics.PLANT_OUTPUT if isfinite(self._y_m) else topics.REFERENCE
            return DiagnosticStatus.WARN, f'waiting for {missing}'
        return STATES[self._last.estimate.status]

    def _counts(self) -> dict[str, int]:
        statistics, commands = self._statistics, self._commands
        return {
            'samples': statistics.used, 'lost': statistics.lost, 'late': commands.late,
            'non-finite dropped': statistics.dropped,
            'before the first reference': statistics.without_reference,
            'without applied_control': commands.unreported,
        }


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(CONTROLLER, ControllerNode, args)


if __name__ == '__main__':
    sys.exit(main())
