"""From an output to a command: which sample it is, what was lost, what the core says to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from math import isfinite, nan

from backlash_ros.core.assembly import (
    build_controller,
    build_limits,
    build_model,
    build_structure,
    first_guess,
)
from backlash_ros.core.control.controller import LONGEST_GAP, ControlStep
from backlash_ros.core.control.limits import Motion, at_rest, last_commands, plausible
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs.executor import Executor, InlineExecutor
from backlash_ros.core.loop.command_history import CommandHistory, report_use
from backlash_ros.core.loop.loop_statistics import LoopStatistics
from backlash_ros.core.loop.phase import Event, Phase, after
from backlash_ros.core.loop.sample_counter import Arrival, Output, SampleCounter
from backlash_ros.core.parameters import Parameters

STILL_BAND = 6.0  # standard deviations of the noise on y within which it stands still
# Live parameters that only a new structure takes up.
OF_THE_STRUCTURE = (
    'tracking.input_weight', 'tracking.integral_weight', 'inverse.caution',
    'estimator.output_noise_std',
)


class ControlLoop:
    """Answers outputs with commands, whatever the driver does.

    send: takes v to the driver. now_ns: the clock of the stamps. estimate: to begin with, None for
    what was known before. counter: goes on counting where another loop has ended. v: the newest
    command, 0 as long as nobody knows (knows_v) which one acts. reports: v and stamp [ns] of what
    the driver has reported since the last call. executor: where fits are made, None for here.
    told: G(z) as the parameters have it. phase: see phase.py.
    """

    def __init__(
        self, p: Parameters, send: Callable[[float], None], now_ns: Callable[[], int],
        estimate: Estimate | None, counter: SampleCounter, v: float | None = None,
        reports: Callable[[], Iterable[tuple[float, int]]] = tuple,
        executor: Executor | None = None,
    ) -> None:
        self.statistics = LoopStatistics(STILL_BAND * p.estimator.output_noise_std)
        self.counter = counter
        self.commands = CommandHistory(p.sample_period, report_use(p))
        self.y_m = nan  # the newest one
        self.v, self.knows_v = v or 0.0, v is not None
        self.phase = Phase.BEGINS
        self.adapting = self.compensating = True
        self.last: ControlStep | None = None
        self.heard_at: float | None = None  # on the steady clock [s]
        self._p, self._send, self._now_ns, self._reports = p, send, now_ns, reports
        self._lockstep = p.lockstep
        self._missing = 0  # outputs since the newest one that was used
        self._unsent = 0  # those of them that were never published
        self._restarted = False  # whether sender or clock restarted since then
        self._other_ns = 0  # when another controller was last heard to command
        self.executor = executor or InlineExecutor()
        self.core = build_controller(p, estimate, self.executor)
        self.told = build_model(p)

    @property
    def estimate(self) -> Estimate:
        """What is known of the backlash."""
        return self.core.estimator.estimate

    def renew(self, estimate: Estimate) -> None:
        """Go on from the present v with a new core that begins with these estimates.

        Nothing is known of the state of the plant then.
        """
        if self.phase is Phase.RUNS:
            self._happens(Event.INTERRUPTION)
        self._renew_core(estimate)

    def reset(self) -> None:
        """Begin with the estimates of estimator.initial."""
        self.renew(first_guess(self._p))

    def close(self) -> None:
        """Give back what it holds elsewhere; it answers no more."""
        self.core.close()

    def adapt(self, adapting: bool) -> None:
        """Learn, or hold the estimates."""
        self.adapting = self.core.estimator.adapting = adapting

    def compensate(self, compensating: bool) -> None:
        """Cancel the gap, or invert the slope alone."""
        self.compensating = self.core.compensating = compensating

    def take_reference(self, y_m: float) -> bool:
        """Take in a reference; an absurd one is counted and the last one holds."""
        if not plausible(y_m):
            self.statistics.note_bad_reference()
            return False
        self.y_m = y_m
        return True

    def hear_reports(self) -> None:
        """Take in what the driver has reported meanwhile."""
        for v, stamp_ns in self._reports():
            self.take_applied(v, stamp_ns)

    def take_applied(self, v: float, stamp_ns: int) -> None:
        """Take in a v that the driver reports to have applied."""
        if plausible(v):
            self.commands.report(v, stamp_ns)
        else:
            self.statistics.dropped += 1

    @property
    def begins(self) -> bool:
        """Whether the next command is the first one, since the start or an interruption."""
        return self.phase in (Phase.BEGINS, Phase.SILENT)

    @property
    def silent(self) -> bool:
        """Whether the driver was given up for the time being."""
        return self.phase is Phase.SILENT

    @property
    def standing_down(self) -> bool:
        """Whether another controller commands the actuator, so that nothing is sent."""
        return self.phase is Phase.STANDS_DOWN

    def learn_v(self, stamp_ns: int) -> bool:
        """Take the v that the driver reports with this output for the one that acts, if it does.

        Returns whether it is known now which one acts.
        """
        reported = self.commands.newest_report(stamp_ns)
        # A report is about the interval before it, which a command in it outdates: one that was
        # heard, or, while waiting outputs are answered, an own one.
        period_ns = self._p.sample_period * 1e9
        commanded_ns = max(self._other_ns, self.commands.newest_ns)
        if isfinite(reported) and stamp_ns > commanded_ns + period_ns:
            self.go_on_from(self.core.command_of(reported))
        return self.knows_v

    def answer(self, output: Output, arrival: Arrival | None = None) -> ControlStep | None:
        """Count y(k), learn from it, and send v(k); None where the message brings no command.

        arrival: of an output that was counted already.
        """
        if arrival is None:
            arrival = self.counter.count(output.stamp_ns, output.sequence, output.numbered)
        return self.step(output, arrival, self.y_m)

    def skip(self, arrival: Arrival) -> None:
        """Leave a sample unanswered of which this loop has no output."""
        if arrival.is_sample and not self.standing_down:
            if arrival.missing or arrival.restarted:
                self._note_missing(arrival)
            self._missing += 1

    def step(self, output: Output, arrival: Arrival, y_m: float) -> ControlStep | None:
        """Like `answer`, for a sample that was counted already, with its own reference."""
        if not self._is_usable(output, arrival, y_m):
            return None
        if self._missing or self._restarted or self.silent:
            self._interrupt_if_long()
        self.hear_reports()
        step = self._step_core(output.y, y_m, output.stamp_ns)
        self.send(step.v)
        latency_s = (time.time_ns() - output.sent_ns) * 1e-9
        self.statistics.note(output.y, step.v, self.core.inverse.limited, latency_s)
        self.last = step
        return step

    def _is_usable(self, output: Output, arrival: Arrival, y_m: float) -> bool:
        """Count a message of y; returns whether there is a command to be made of it."""
        statistics = self.statistics
        statistics.note_arrival(output.stamp_ns, output.received_ns)
        if self.standing_down:
            return False
        if not arrival.is_sample:
            statistics.extra += 1
            return False
        self.commands.note_transit(output.received_ns - output.sent_ns)
        if arrival.missing or arrival.restarted:
            self._note_missing(arrival)
        if not plausible(output.y):
            # A sensor that has nothing to say is as good as silent.
            statistics.note_bad_output()
            self._missing += 1
            return False
        self.heard_at = time.monotonic()
        if not plausible(y_m):
            statistics.without_reference += 1
            self._missing += 1
            return False
        return True

    def send(self, v: float) -> None:
        """Send a command and note when it left; nothing while another controller commands."""
        if not self.standing_down:
            if v != self.core.motion.v:  # it is none of the core
                self.core.motion = Motion(v, v - self.v, v)
            self._put_out(v)
            self.commands.publish(v, self._now_ns())

    @property
    def zero(self) -> float:
        """The v nearest to 0 within the limits."""
        return self.core.limits.zero

    def last_commands(self, action: str) -> Iterator[float]:
        """Commands that end the loop as on_stop or on_timeout say, from the present v on.

        None where nobody knows v: then this loop has not commanded anything either.
        """
        if not self.knows_v:
            return iter(())
        motion = self.core.motion
        return last_commands(
            action, motion if motion.v == self.v else at_rest(self.v), lambda: self.core.limits
        )

    def give_up(self) -> None:
        """The driver is silent: whenever it comes back, its state will be unknown."""
        before = self.phase
        self._happens(Event.TIMEOUT)
        if self.phase is not before:
            self._renew_core(self.estimate)

    def stand_down(self) -> None:
        """Leave the actuator to another controller."""
        self._happens(Event.RIVAL)

    def hear_other(self, v: float) -> None:
        """Take in a command of the controller that is in charge."""
        if self.standing_down and plausible(v):
            self.go_on_from(v)
            self._other_ns = self._now_ns()

    def resume(self) -> None:
        """Command again, from the newest v that was heard; the state of the plant is unknown."""
        self._happens(Event.RIVAL_GONE)
        self.heard_at = None
        self._renew_core(self.estimate)

    def take_up(self, p: Parameters) -> None:
        """Use other values of the live parameters; what was learned stays."""
        before, self._p = self._p, p
        core = self.core
        core.limits = build_limits(p)
        core.inverse.set_band(p.inverse.direction_band)
        core.inverse.take_up = p.inverse.take_up_rate * p.sample_period
        core.estimator.retune(p)
        if any(p[name] != before[name] for name in OF_THE_STRUCTURE):
            structure = build_structure(p)
            structure.go_on_from(core.structure)
            core.structure = structure

    def _happens(self, event: Event) -> None:
        self.phase = after(self.phase, event)

    def _renew_core(self, estimate: Estimate) -> None:
        before = self.core
        self.core = build_controller(self._p, estimate, self.executor)
        self.core.go_on_from(before)
        before.close()
        self.core.compensating = self.compensating
        self.core.estimator.adapting = self.adapting
        self._missing = 0

    def _put_out(self, v: float) -> None:
        self.v, self.knows_v = v, True
        self._send(v)

    def go_on_from(self, told: float) -> None:
        """Take this v for the one that acts."""
        known = self.v if self.knows_v else None
        self.v, self.knows_v = self.core.limits.go_on_from(told, known), True

    def _note_missing(self, arrival: Arrival) -> None:
        self._missing += arrival.missing
        self._unsent += arrival.unsent
        self._restarted = self._restarted or arrival.restarted
        # What came before the first sample that is used was not lost: nobody listened.
        if self.phase is Phase.RUNS and not arrival.restarted:
            self.statistics.lost += arrival.missing
            self.statistics.unsent += arrival.unsent

    def _interrupt_if_long(self) -> None:
        """Begin with a new core where there is too much to step over."""
        timeout = self._p.timeout.plant_output
        too_long = self._missing > LONGEST_GAP or (
            not self._lockstep
            and 0.0 < timeout < self._missing * self._p.sample_period
        )
        if self.silent or self._restarted or (too_long and self.phase is Phase.RUNS):
            self.statistics.interruptions += 1
            self._happens(Event.INTERRUPTION)
            self._renew_core(self.estimate)
        self._restarted = False

    def _step_core(self, y: float, y_m: float, stamp_ns: int) -> ControlStep:
        """Step the core over the missing outputs to y, with the v that was really applied."""
        core = self.core
        if self.phase is Phase.BEGINS:
            self._happens(Event.ANSWER)
            self._missing = self._unsent = 0
            if not self._lockstep:
                self.learn_v(stamp_ns)
            core.start_from(self.v)
            self.commands.begin(stamp_ns)
            return core.step(y, y_m)
        if self._lockstep:
            lost, self._missing, self._unsent = self._missing, 0, 0
            return core.step(y, y_m, lost)
        return core.step(y, y_m, *self._acted(stamp_ns))

    def _acted(self, stamp_ns: int) -> tuple[int, list[float], list[float], list[float]]:
        """Outputs missing since the last one that was used, and what acted up to this one.

        Per interval: v as the driver reports it, commands that may have acted instead, those that
        should have.
        """
        commands, lost, unsent = self.commands, self._missing, self._unsent
        self._missing = self._unsent = 0
        # Late commands are counted even where the driver says which ones it applied.
        acted, others = commands.over(lost + 1, stamp_ns, self.counter.due_ns)
        return lost, commands.reported_over(lost + 1, stamp_ns, unsent), others, acted
