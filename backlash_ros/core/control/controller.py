"""The adaptive backlash inverse controller: estimator, structure, inverse and limits."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from math import nan
from typing import NamedTuple

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import LARGEST_SIGNAL, Limits, at_rest, plausible
from backlash_ros.core.control.protocol import ControlInput, ControlStructure
from backlash_ros.core.control.redesign import Redesign
from backlash_ros.core.control.serial_plant import SerialPlant
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs import Executor
from backlash_ros.core.law import Interval, Law, StateSource

# Lost outputs in a row that are stepped over; after more nothing is left to predict from them.
LONGEST_GAP = 1000


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

    compensating: False inverts the slope alone, as if there were no gap. motion: of the newest
    command. redesigns: whether the structure is designed anew for the better models of G that the
    estimator proposes. serial: the motor and G as the structure sees them; None where v is what it
    commands. executor: where it is designed, None for here.
    """

    def __init__(
        self, estimator: Law, structure: ControlStructure, inverse: BacklashInverse,
        limits: Limits, redesign: bool = False, serial: SerialPlant | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.estimator, self.structure = estimator, structure
        self.inverse, self.limits = inverse, limits
        self.motion = at_rest(inverse.v)
        self.compensating = True
        self.lost_samples = 0
        self.redesign = Redesign(executor or Executor()) if redesign else None
        self._serial = serial
        self._interval: Interval | None = None  # that which began with the newest command

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
        alternatives: Sequence[float] = (), commands: Sequence[float] = (),
    ) -> ControlStep:
        """Learn from y(k), and return the command for sample k.

        y, y_m: output and reference, finite. lost: samples >= 0 that never arrived since the last
        call; the plant went on with the last v through all of them. applied: the v that was
        really applied in each of the lost + 1 intervals since then, if it is known. commands: those
        that acted in them, if it is not the last one. alternatives: commands that may have acted
        instead, nan where none may.
        """
        if not all(map(plausible, (y, y_m, *applied, *commands))):
            raise ValueError(
                f'y={y!r}, y_m={y_m!r}, applied={applied!r} and commands={commands!r} must be '
                f'finite and no larger than {LARGEST_SIGNAL:g}'
            )
        if self._interval is not None:
            for i in range(lost + 1):
                interval = self._interval
                if commands:
                    interval = interval._replace(v=commands[i])
                if alternatives and not applied:
                    interval = interval._replace(other=alternatives[i])
                self._learn(y if i == lost else None, interval, applied[i] if applied else None)
            self.lost_samples += lost
        return self._control(y, y_m)

    def refine(self) -> None:
        """Do what the command did not have to wait for; who has no time for it leaves it out."""
        self.structure.prepare()
        self.estimator.refine()
        if self.redesign is None:
            return
        design = self.redesign.due(self.estimator.proposal, self.structure, self._serial)
        if design is not None:
            # At once and together: x_hat and gains of two models do not fit each other.
            self.estimator.adopt(design.model)
            self.redesign.adopted = design.model
            if self._serial is not None:
                self._serial.adopt(design.commanded)
            if design.gains is not None:
                self.structure.adopt(design.gains, self._source)

    def command_of(self, v: float) -> float:
        """The command at which the motor rests at a v that was reported."""
        return v if self._serial is None else self._serial.command_of(v)

    def start_from(self, v: float) -> None:
        """Say which command acts now, so that the first one goes on from there."""
        if v != self.motion.v:
            self.motion = at_rest(v)
        self.inverse.start_from(v)

    def go_on_from(self, before: AdaptiveController) -> None:
        """Take over from the controller before this one, as the state of the plant got unknown.

        v, the line that is engaged and the learned model of G stay.
        """
        own, self.inverse = self.inverse, copy(before.inverse)
        self.inverse.direction_band, self.inverse.take_up = own.direction_band, own.take_up
        self.motion = before.motion
        if self.redesign is not None and before.redesign is not None:
            self.redesign.considered = before.redesign.considered
            adopted = self.redesign.adopted = before.redesign.adopted
            if adopted is not None:
                self.estimator.adopt(adopted)
                if self._serial is not None:
                    self._serial.adopt(self._serial.before(adopted))
        self.structure.go_on_from(before.structure, state_known=False)

    def close(self) -> None:
        """Give back what estimator and designs hold elsewhere."""
        self.estimator.close()
        if self.redesign is not None:
            self.redesign.close()

    @property
    def _source(self) -> StateSource:
        """Who knows the state of what the structure commands."""
        return self.estimator if self._serial is None else self._serial

    def _learn(self, y: float | None, interval: Interval, applied: float | None) -> None:
        """Take in y(k), None if it was lost; applied: v of the interval as it was reported."""
        serial, estimate = self._serial, self.estimator.estimate
        if serial is not None:
            # Where nothing is reported the motor is where the command takes it.
            position = serial.position(interval.v, estimate)
            applied = position if applied is None else applied
            serial.update(y, interval.v, applied, estimate)
            interval = interval._replace(other=nan)
        if applied is not None:
            interval = interval._replace(v=applied)
        self.estimator.update(y, interval)

    def _control(self, y: float, y_m: float) -> ControlStep:
        """The command for this sample, within the limits."""
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
        inverse.applied(self.motion.v)
        self._interval = Interval(self.motion.v, y_m, u_d, f)
        return ControlStep(y_m, y, u_d, self.motion.v, estimate)
