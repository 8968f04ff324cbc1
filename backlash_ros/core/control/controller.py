"""The adaptive backlash inverse controller: estimator, structure, inverse and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import LARGEST, Limits, at_rest
from backlash_ros.core.control.protocol import ControlInput, Structure
from backlash_ros.core.control.serial_plant import SerialPlant
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs.executor import LOST, Channel, Executor, Failure
from backlash_ros.core.law import Interval, Law, StateSource
from backlash_ros.core.plant.state_model import StateModel

# Samples after which a better design takes over though v crosses the gap: an unstable loop never
# stops to.
LONGEST_WAIT = 200
# Lost outputs in a row that are stepped over; after more nothing is left to predict from them.
LONGEST_GAP = 1000
REFINE_SHARE = 0.3  # of a sample period for `refine`, after the command


class ControlStep(NamedTuple):
    """What one sample made: the command, and the estimate it was computed with."""

    y_m: float
    y: float
    u_d: float
    v: float
    estimate: Estimate


class AdaptiveController:
    """Learns the backlash from v and y and publishes v = BI(u_d), section 3 of the paper.

    Call `step` once per received y, and `refine` when v is on its way.

    compensating: False inverts the slope alone, as if there were no gap.
    redesign: whether the structure is designed anew for the better models of G that the estimator
    proposes. serial: the motor and G as the structure sees them; None where v is what it commands.
    executor: where it is designed, None for here. failed_designs: those without a result.
    """

    def __init__(
        self, estimator: Law, structure: Structure, inverse: BacklashInverse,
        limits: Limits, redesign: bool = False, serial: SerialPlant | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.estimator, self.structure = estimator, structure
        self.inverse, self.limits = inverse, limits
        self.motion = at_rest(inverse.v)  # of the newest command
        self.compensating = True
        self.lost_samples = 0
        self.adopted: StateModel | None = None  # the learned model of G that is in use
        self._redesign, self._serial = redesign, serial
        self._considered: StateModel | None = None  # the proposal that was designed for last
        self._designed: StateModel | None = None  # that, with the motor in front
        self.failed_designs = 0
        self._executor = executor or Executor()
        self._channel: Channel | None = None  # for designs, from the first one on
        self._gains: object | None = None  # that were made, until they may take over
        self._waited = 0  # samples for which it could not
        self._interval: Interval | None = None  # that which began with the newest command

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
        alternatives: Sequence[float] = (), commands: Sequence[float] = (),
    ) -> ControlStep:
        """Learn from y(k), and return the command for sample k.

        y, y_m: output and reference, finite. lost: samples that never arrived since the last
        call; the plant went on with the last v through all of them. applied: the v that was
        really applied in each of the lost + 1 intervals since then, if it is known. commands: those
        that acted in them, if it is not the last one. alternatives: commands that may have acted
        instead, nan where none may.
        """
        _check_sample(y, y_m)
        if lost < 0:
            raise ValueError(f'lost={lost!r} must be >= 0')
        if applied or alternatives or commands:
            _check_intervals(lost + 1, applied, alternatives, commands)
        if self._interval is not None:
            self._learn(y, self._interval, lost, applied, alternatives, commands)
        return self._control(y, y_m)

    def _control(self, y: float, y_m: float) -> ControlStep:
        inverse, estimate = self.inverse, self.estimator.estimate
        used = estimate
        if not self.compensating:
            used = replace(estimate, c_r=0.0, c_l=0.0)
        elif self._serial is not None:
            used = self._serial.for_command(estimate)
        gap = used.c_r - used.c_l
        crossing = max(inverse.samples_across(gap), self.limits.samples_across(gap))
        inputs = ControlInput(y_m, y, used, self._source, crossing)
        u_d, v, f = self.structure.control(inputs, inverse)
        self.motion = self.limits.apply(v, self.motion)
        v = self.motion.v
        inverse.applied(v)
        self._interval = Interval(v, y_m, u_d, f)
        return ControlStep(y_m, y, u_d, v, estimate)

    @property
    def _source(self) -> StateSource:
        """Who knows the state of what the structure commands."""
        return self.estimator if self._serial is None else self._serial

    def command_of(self, v: float) -> float:
        """The command at which the motor rests at a v that was reported."""
        return v if self._serial is None else self._serial.command_of(v)

    def close(self) -> None:
        """Give back what estimator and designs hold elsewhere."""
        self.estimator.close()
        if self._channel is not None:
            self._channel.close()

    def start_from(self, v: float) -> None:
        """Say which command acts now, so that the first one goes on from there."""
        if v != self.motion.v:
            self.motion = at_rest(v)
        self.inverse.start_from(v)

    def go_on_from(self, before: AdaptiveController) -> None:
        """Take over from the controller before this one, as the state of the plant got unknown.

        v, the line that is engaged and the learned model of G stay.
        """
        self.inverse.go_on_from(before.inverse)
        self.motion = before.motion
        self._considered = before._considered
        if self._redesign and before.adopted is not None:
            self.estimator.adopt(before.adopted)
            self.adopted = before.adopted
            if self._serial is not None:
                self._serial.adopt(self._serial.before(before.adopted))
        self.structure.go_on_from(before.structure, state_known=False)

    def refine(self, budget_s: float = inf) -> None:
        """Do what the command did not have to wait for, for about so many seconds at most.

        Who has no time for it leaves it out: a search for the gap pauses.
        """
        self.estimator.refine(budget_s)
        if self._redesign:
            self._make_gains()

    @property
    def designing(self) -> bool:
        """Whether gains for a better model of G are being made."""
        return self._channel is not None and self._channel.busy

    def _make_gains(self) -> None:
        """Have gains made for the newest proposal, and use them when the structure may change."""
        self._take_gains()
        proposal = self.estimator.proposal
        if proposal is not None and proposal is not self._considered:
            self._design_for(proposal)
        if self._gains is None:
            return
        self._waited += 1
        if self.structure.may_change or self._waited > LONGEST_WAIT:
            # At once and together: x_hat and gains of two models do not fit each other.
            assert self._considered is not None
            self.estimator.adopt(self._considered)
            self.adopted = self._considered
            if self._serial is not None:
                assert self._designed is not None
                self._serial.adopt(self._designed)
            self.structure.adopt(self._gains, self._source)
            self._gains = None

    def _design_for(self, proposal: StateModel) -> None:
        """Have gains made for a model of G, once those for the one before are there."""
        channel = self._channel = self._channel or self._executor.open()
        if channel.busy:
            return
        self._considered, self._gains, self._waited = proposal, None, 0
        self._designed = proposal if self._serial is None else self._serial.before(proposal)
        channel.submit(self.structure.redesign(self._designed))
        self._take_gains()

    def _take_gains(self) -> None:
        """Take up gains that are finished; None where the present ones are safer."""
        if self._channel is None or not self._channel.busy:
            return
        gains = self._channel.poll()
        if not isinstance(gains, Failure):
            self._gains = gains
        elif gains.kind == LOST:
            self._considered = None  # the same again, by another worker
        else:
            self.failed_designs += 1

    def _learn(
        self, y: float, interval: Interval, lost: int, applied: Sequence[float],
        alternatives: Sequence[float], commands: Sequence[float],
    ) -> None:
        """Learn from y(k) and the samples lost before it; interval: that of the newest command."""
        serial, estimator = self._serial, self.estimator
        as_made = serial is None and not (applied or alternatives or commands)
        command, y_m, u_d, f, other = interval
        for i in range(lost + 1):
            measured = y if i == lost else None
            if as_made:
                estimator.update(measured, interval)
                continue
            if commands:
                command = commands[i]
            # Where nothing is reported the motor is where the command takes it.
            v = command if serial is None else serial.position(command, estimator.estimate)
            if applied:
                v = applied[i]
            elif alternatives and serial is None:
                other = alternatives[i]
            if serial is not None:
                serial.update(measured, command, v, estimator.estimate)
            estimator.update(measured, Interval(v, y_m, u_d, f, other))
        self.lost_samples += lost


def _check_sample(y: float, y_m: float) -> None:
    if not (-LARGEST <= y <= LARGEST and -LARGEST <= y_m <= LARGEST):
        raise ValueError(f'y={y!r} and y_m={y_m!r} must be finite and no larger than '
                         f'{LARGEST:g}')


def _check_intervals(
    count: int, applied: Sequence[float], alternatives: Sequence[float], commands: Sequence[float],
) -> None:
    for values in (applied, alternatives, commands):
        if values and len(values) != count:
            raise ValueError(
                f'applied, alternatives and commands must have lost + 1 = {count!r} values each'
            )
    for v in (*applied, *commands):
        if not -LARGEST <= v <= LARGEST:
            raise ValueError(
                f'applied={applied!r} and commands={commands!r} must be finite and no larger than '
                f'{LARGEST:g}'
            )
