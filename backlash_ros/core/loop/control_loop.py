"""From outputs to commands, for all joints: count → learn → control → limit → send → note."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from itertools import cycle
from math import isfinite, nan
from typing import NamedTuple

from backlash_ros.core.assembly import build_controller, build_limits, first_guess
from backlash_ros.core.control.controller import LONGEST_GAP, ControlStep
from backlash_ros.core.control.limits import Motion, at_rest, last_commands, plausible
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.jobs import Executor
from backlash_ros.core.loop.command_history import CommandHistory, report_use
from backlash_ros.core.loop.loop_statistics import Counts, LoopStatistics
from backlash_ros.core.loop.sample_counter import NEXT_SAMPLE, Arrival, Output, SampleCounter
from backlash_ros.core.parameters import Parameters


class Phase(Enum):
    """State of a loop: whether it commands, and whether it knows the state of the plant.

    BEGINS → RUNS with the first answer; RUNS → BEGINS when the state of the plant is lost. Both →
    SILENT after timeout.plant_output without an output; SILENT → BEGINS with the next one. All →
    STANDS_DOWN if another controller was first; STANDS_DOWN → BEGINS when that one is gone.
    """

    BEGINS = 'begins'
    RUNS = 'runs'
    SILENT = 'silent'
    STANDS_DOWN = 'stands down'


class Driver(NamedTuple):
    """What a loop needs from outside. now_ns: clock of stamps. may_report: if v may be reported.

    applied: topic of reports. warn: warns the user. steady_s: monotonic clock. wall_ns: of sent_ns.
    """

    now_ns: Callable[[], int]
    may_report: Callable[[], bool] = lambda: False
    applied: str = 'applied_control'
    warn: Callable[[str], object] = lambda text: None
    steady_s: Callable[[], float] = time.monotonic
    wall_ns: Callable[[], int] = time.time_ns


@dataclass
class Newest:
    """The newest reference, and when y_m and y last came [s, steady clock]; nan before."""

    y_m: float = nan
    y_m_at: float = nan
    y_at: float = nan
    unanswered: int = 0  # outputs that had to wait for a known v


def still_band(p: Parameters) -> float:
    """Motion of y within which it counts as standing still: six standard deviations of noise."""
    return 6.0 * p.estimator.output_noise_std


class ControlLoop:
    """Answers the outputs of one joint with commands, whatever the driver does.

    estimate: to begin with; None for that of known_before(p). v: the command that acts; None if it
    is unknown, and then taken for 0 (knows_v: False). executor: computes the fits; None: at once.
    """

    def __init__(
        self, p: Parameters, driver: Driver, estimate: Estimate | None, counter: SampleCounter,
        v: float | None = None, executor: Executor | None = None,
    ) -> None:
        self.counter, self.heard, self.phase = counter, Newest(), Phase.BEGINS
        counts = LoopStatistics(still_band=still_band(p))
        self.commands = CommandHistory(p.sample_period, report_use(p), counts)
        self.executor = executor or Executor()
        self.core = build_controller(p, estimate, self.executor)
        self.knows_v = v is not None
        if v is not None:
            self.core.motion = at_rest(v)
        self.driver, self._p = driver, p
        self._gap = NEXT_SAMPLE  # samples missing since the newest output that was used
        self._ending: Iterator[float] = iter(())  # last commands, see `end`

    @property
    def statistics(self) -> LoopStatistics:
        return self.commands.counts

    @property
    def counted(self) -> dict[str, int]:
        names = (*(each.name for each in fields(Counts)), 'wraps')
        return {name: getattr(self.statistics, name) for name in names} | {
            'dead_workers': self.executor.restarts,
            'failed_fits': self.core.estimator.report.failed_fits}

    @property
    def estimate(self) -> Estimate:
        return self.core.estimator.estimate

    @property
    def v(self) -> float:
        """The newest command that acts, whoever has sent it."""
        return self.core.motion.v

    @property
    def silent(self) -> bool:
        return self.phase is Phase.SILENT

    @property
    def standing_down(self) -> bool:
        """Whether another controller commands the actuator, so that nothing is sent."""
        return self.phase is Phase.STANDS_DOWN

    # --- at every sample -------------------------------------------------------------------------

    def take_reference(self, y_m: float) -> None:
        """Take in a reference; an implausible one is only counted, and the last one holds."""
        if plausible(y_m):
            self.heard.y_m, self.heard.y_m_at = y_m, self.driver.steady_s()
        else:
            self.statistics.bad_references += 1

    def take_applied(self, v: float, stamp_ns: int) -> None:
        if plausible(v):
            self.commands.report(v, stamp_ns)
        else:
            self.statistics.bad_reports += 1

    def answer(self, output: Output, arrival: Arrival | None = None) -> ControlStep | None:
        """Count y(k) and learn from it; return the step to v(k), None if no command follows.

        The caller sends v(k), then notes it. arrival: of an output that has been counted already.
        """
        if not self._is_usable(output, arrival or self.counter.count(*output.counted)):
            return None
        return self._step_core(output.y, self.heard.y_m, output.stamp_ns)

    def note_answer(self, step: ControlStep, output: Output) -> None:
        """Note that v(k), the answer to this y(k), has just left."""
        self.note_sent(step.v)
        took_s = (self.driver.wall_ns() - output.sent_ns) * 1e-9
        self.statistics.note(output.y, step.v, self.core.inverse.limited,
                             step.estimate.status is Status.INCONSISTENT, took_s)

    def note_sent(self, v: float) -> None:
        self.knows_v = True
        self.commands.publish(v, self.driver.now_ns())

    def skip(self, arrival: Arrival) -> None:
        """Note a sample of which this loop has no output."""
        if arrival.is_sample and not self.standing_down:
            self._note_missing(arrival)
            self._note_missing(Arrival(missing=1), lost=False)

    def _is_usable(self, output: Output, arrival: Arrival) -> bool:
        """Count a message of y; return whether it is to be answered with a command."""
        statistics = self.statistics
        if self.standing_down or not arrival.is_sample:
            statistics.extra += not self.standing_down
            return False
        self.commands.note_transit(output.received_ns - output.sent_ns)
        if arrival is not NEXT_SAMPLE:
            self._note_missing(arrival)
        if plausible(output.y):
            self.heard.y_at = self.driver.steady_s()
            if plausible(self.heard.y_m):
                return self._may_answer(output)
            statistics.without_reference += 1
        else:
            # A sensor without a valid value is as good as silent.
            statistics.bad_outputs += 1
        self._note_missing(Arrival(missing=1), lost=False)
        return False

    def _note_missing(self, arrival: Arrival, lost: bool = True) -> None:
        _, missing, restarted, unsent = self._gap
        self._gap = Arrival(True, missing + arrival.missing, restarted or arrival.restarted,
                            unsent + arrival.unsent)
        # Nothing is lost before the first sample that is used: the loop was not running.
        if lost and self.phase is Phase.RUNS and not arrival.restarted:
            self.statistics.lost += arrival.missing
            self.statistics.unsent += arrival.unsent

    def _may_answer(self, output: Output) -> bool:
        """Begin anew if too much is missing; return whether the output may be answered."""
        p, gap = self._p, self._gap
        stalled = not p.lockstep and 0.0 < p.timeout.plant_output < gap.missing * p.sample_period
        too_long = self.phase is Phase.RUNS and (gap.missing > LONGEST_GAP or stalled)
        if self.silent or gap.restarted or too_long:
            self.statistics.interruptions += 1
            self.phase = Phase.BEGINS
            self.commands.origin.restart()
            self.renew(self.estimate)
        return self.phase is Phase.RUNS or p.lockstep or self._may_begin(output)

    def _may_begin(self, output: Output) -> bool:
        """Return whether the v that acts is known, or waiting for a report of it is in vain."""
        p, driver = self._p, self.driver
        if missing := p.missing_limits:
            driver.warn(f'{", ".join(missing)}: not set, so nothing keeps v within what the '
                        'actuator can bear: set them')
        reported = self.commands.newest_report(output.stamp_ns)
        if isfinite(reported):
            self._go_on_from(self.core.command_of(reported))
        if self.knows_v:
            return True
        self.heard.unanswered += 1
        longest = min(20, max(int(0.5 / p.sample_period), 1))
        if driver.may_report() and self.heard.unanswered <= longest:
            return False
        if p.io.style == 'joint_state_topic':
            # Apart from the gap v and y are the same angle: the joint stays where it is.
            self._go_on_from(output.y / self.estimate.m)
        else:
            driver.warn('nobody says which v acts now, so the first command goes on from 0: '
                        f'publish {driver.applied}, or set control.initial')
        return True

    def _step_core(self, y: float, y_m: float, stamp_ns: int) -> ControlStep:
        """Step the core over the missing outputs to y, with the v that was really applied."""
        core, commands = self.core, self.commands
        (_, lost, _, unsent), self._gap = self._gap, NEXT_SAMPLE
        if self.phase is Phase.BEGINS:
            self.phase = Phase.RUNS
            core.start_from(self.v)
            commands.output_ns = stamp_ns
            return core.step(y, y_m)
        if self._p.lockstep:
            return core.step(y, y_m, lost)
        # Late commands are counted even if the driver reports which ones it applied.
        acted, others = commands.over(lost + 1, stamp_ns, self.counter.due_ns)
        reports = commands.reported_over(lost + 1, stamp_ns, unsent)
        origin, told = commands.origin, acted[-1] / core.command_of(1.0)
        if reports and origin.changed_by(reports[-1] + origin.value, told, self.estimate):
            self.driver.warn(f'{self.driver.applied} is {origin.value:.4g} above v: taken as '
                             'the zero offset of the motor encoder, and subtracted')
            self.renew(origin.before)
            return self._step_core(y, y_m, stamp_ns)
        return core.step(y, y_m, lost, reports, others, acted)

    # --- whatever else happens -------------------------------------------------------------------

    @property
    def is_overdue(self) -> bool:
        """Whether the driver has been silent for too long and has not been given up yet."""
        silent_s = self.driver.steady_s() - self.heard.y_at
        return self.phase in (Phase.BEGINS, Phase.RUNS) \
            and 0.0 < self._p.timeout.plant_output < silent_s

    def give_up(self) -> None:
        """Give the silent driver up: end as on_timeout says, and forget the state of the plant."""
        if self.phase in (Phase.BEGINS, Phase.RUNS):
            self.phase = Phase.SILENT
            self.renew(self.estimate)
            self.end(self._p.on_timeout)

    def stand_down(self) -> None:
        self.phase, self._ending = Phase.STANDS_DOWN, iter(())

    def hear_other(self, v: float) -> None:
        if self.standing_down and plausible(v):
            self._go_on_from(v)
            self.commands.newest_ns = self.driver.now_ns()

    def resume(self) -> None:
        """Command again, from the newest v that was heard; the state of the plant is unknown."""
        self.phase, self.heard.y_at = Phase.BEGINS, nan
        self.renew(self.estimate)

    def end(self, action: str) -> None:
        """Have next_command yield the last commands of an action, if v is known: last_commands."""
        self._ending = last_commands(action, self.core.motion, lambda: self.core.limits) \
            if self.knows_v else iter(())

    def next_command(self) -> float | None:
        """The next of the last commands, to be sent and noted; None after the last one."""
        v = next(self._ending, None)
        if v is not None:
            self.core.motion = Motion(v, v - self.v, v)
        return v

    def renew(self, estimate: Estimate | None) -> None:
        """Continue from the present v with a new core, which begins with these estimates if any."""
        if self.phase is Phase.RUNS:
            self.phase = Phase.BEGINS
        before = self.core
        self.core = core = build_controller(self._p, estimate, self.executor)
        core.go_on_from(before)
        before.close()
        core.compensating = before.compensating
        core.estimator.adapting = before.estimator.adapting
        self._gap, self._ending = NEXT_SAMPLE, iter(())

    def reset(self) -> None:
        self.renew(first_guess(self._p))

    def adapt(self, adapting: bool) -> None:
        self.core.estimator.adapting = adapting

    def compensate(self, compensating: bool) -> None:
        self.core.compensating = compensating

    def take_up(self, p: Parameters) -> None:
        """Apply new values of the live parameters, and keep what was learned."""
        self._p, core = p, self.core
        self.statistics.still_band = still_band(p)
        core.limits = build_limits(p)
        core.inverse.direction_band = p.inverse.direction_band
        core.inverse.take_up = p.inverse.take_up_rate * p.sample_period
        core.retune(p)

    def _go_on_from(self, told: float) -> None:
        v = self.core.limits.go_on_from(told, self.v if self.knows_v else None)
        if v != self.v:
            self.core.motion = at_rest(v)
        self.knows_v = True


class JointLoops:
    """Answers each message about all joints with one message of commands for all.

    driver: returns the Driver of a joint. before: initial estimates, of joints that do not begin
    with known_before(p). by_name: in the order of `joints`; a single one may be nameless.
    """

    def __init__(
        self, p: Parameters, send: Callable[[Mapping[str, float]], None],
        driver: Callable[[str], Driver], before: Mapping[str, Estimate],
        counter: SampleCounter, v: Mapping[str, float | None] | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.counter, self._send, self._together = counter, send, p.io.together
        self.by_name = {
            joint: ControlLoop(
                p.of_joint(joint), driver(joint), before.get(joint), counter,
                (v or {}).get(joint), executor,
            ) for joint in p.joint_names
        }
        self.loops = tuple(self.by_name.values())
        # Attending to fits at every sample would double its cost, and a fit takes longer anyway.
        # Four times in a row: to read and to take up a fit, to adopt its G, to begin the next fit.
        pause = 1 if p.lockstep else max(round(0.05 / p.sample_period / len(self.loops)), 1)
        self._turns = cycle([turn for loop in self.loops for turn in
                             (*[loop] * min(pause, 4), *[None] * (pause - 4))])

    def answer(self, outputs: Mapping[str, Output]) -> dict[str, ControlStep]:
        """Send v(k) for the y(k) of all joints in `outputs`; return the steps that were made."""
        arrival = self.counter.count(*next(iter(outputs.values())).counted)
        lost = self._together and any(
            loop.silent and not (joint in outputs and isfinite(outputs[joint].y))
            for joint, loop in self.by_name.items())
        if lost:
            outputs = {}  # an arm does not begin while one of its joints is still lost
        steps = {}
        for joint, loop in self.by_name.items():
            if joint not in outputs:
                loop.skip(arrival)
            elif (step := loop.answer(outputs[joint], arrival)) is not None:
                steps[joint] = step
        if steps:
            self._send({joint: step.v for joint, step in steps.items()})
            for joint, step in steps.items():
                self.by_name[joint].note_answer(step, outputs[joint])
        return steps

    def prepare(self, joints: Iterable[str]) -> None:
        """Do the work that the next commands of these joints then need not wait for."""
        self.counter.sender.learn()
        for joint in joints:
            self.by_name[joint].core.prepare()
        if (loop := next(self._turns)) is not None:
            loop.core.refine()

    def take_references(self, y_m: Mapping[str, float]) -> None:
        for joint, value in y_m.items():
            self.by_name[joint].take_reference(value)

    @property
    def overdue(self) -> Sequence[ControlLoop]:
        """Joints that are newly silent, or all that go together, to be given up."""
        overdue = [loop for loop in self.loops if loop.is_overdue]
        return self.loops if overdue and self._together else overdue

    def end(self, action: str) -> list[ControlLoop]:
        """As ControlLoop.end, for the loops that command; return these."""
        ending = [loop for loop in self.loops if loop.statistics.used and not loop.standing_down]
        for loop in ending:
            loop.end(action)
        return ending

    def send_next(self) -> bool:
        """Send the next of the last commands of each joint; return whether there was any."""
        commands = {joint: v for joint, loop in self.by_name.items()
                    if (v := loop.next_command()) is not None}
        if commands:
            self._send(commands)
            for joint, v in commands.items():
                self.by_name[joint].note_sent(v)
        return bool(commands)
