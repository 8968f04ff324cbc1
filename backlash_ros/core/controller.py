"""The adaptive backlash inverse controller: estimator, structure, inverse and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.estimation.protocol import Estimate, Estimator, Interval
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.structure import Situation, Structure

LARGEST = 1e12  # no unit makes a measurement larger; squares of it still are numbers


def plausible(value: float) -> bool:
    """Whether a value can be a measurement at all; nan, inf and absurd magnitudes are not."""
    return abs(value) <= LARGEST


@dataclass(frozen=True)
class Limits:
    """Bounds of v [unit of v] and of its move per sample."""

    low: float = -inf
    high: float = inf
    move: float = inf

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ParameterError(
                'control.min', self.low, f'must be < control.max={self.high!r}'
            )

    @property
    def zero(self) -> float:
        """The v nearest to 0 within the bounds."""
        return min(max(0.0, self.low), self.high)

    def apply(self, v: float, v_before: float) -> float:
        """v within the bounds and not too far from v_before."""
        if self.move < inf:
            v = min(max(v, v_before - self.move), v_before + self.move)
        return min(max(v, self.low), self.high)


class ControlStep(NamedTuple):
    """What one sample made: the command, and the estimate it was computed with."""

    y_m: float
    y: float
    u_d: float
    v: float
    estimate: Estimate


class _Lesson(NamedTuple):
    """An output that is still to be learned from."""

    y: float
    interval: Interval
    lost: int
    applied: Sequence[float]


class AdaptiveController:
    """Learns the backlash from v and y and publishes v = BI(u_d), section 3 of the paper.

    Call `step` once per received y, and `refine` when v is on its way. Learning from y(k) comes
    before v(k) only where the structure feeds y back; else v(k) need not wait for it.

    compensating: False inverts the slope alone, as if there were no gap.
    """

    def __init__(
        self, estimator: Estimator, structure: Structure, inverse: BacklashInverse,
        limits: Limits,
    ) -> None:
        self.estimator, self.structure = estimator, structure
        self.inverse, self.limits = inverse, limits
        self.compensating = True
        self.lost_samples = 0
        self._interval: Interval | None = None
        self._lesson: _Lesson | None = None

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
    ) -> ControlStep:
        """Return the command for sample k.

        y, y_m: output and reference, finite. lost: samples that never arrived since the last
        call; the plant went on with the last v through all of them. applied: the v that was
        really applied in each of the lost + 1 intervals since then, if it is known.
        """
        if not (plausible(y) and plausible(y_m)) or (applied and not all(map(plausible, applied))):
            raise ValueError(
                f'y={y!r}, y_m={y_m!r} and applied={applied!r} must be finite and no larger than '
                f'{LARGEST:g}'
            )
        if lost < 0 or len(applied) not in (0, lost + 1):
            raise ValueError(f'lost={lost!r} must be >= 0 and applied have lost + 1 values')
        if self._lesson is not None:
            self._learn()
        if self._interval is not None:
            self._lesson = _Lesson(y, self._interval, lost, applied)
            if self.structure.needs_output:
                self._learn()
        estimate, inverse = self.estimator.estimate, self.inverse
        v_before = inverse.v
        used = estimate if self.compensating else replace(estimate, c_r=0.0, c_l=0.0)
        command = self.structure.control(Situation(y_m, y, used, self.estimator), inverse)
        v = self.limits.apply(command.v, v_before)
        inverse.applied(v)
        self._interval = Interval(v, y_m, command.u_d, command.f)
        return ControlStep(y_m, y, command.u_d, v, estimate)

    def start_from(self, v: float) -> None:
        """Say which v acts now, so that the first command goes on from there."""
        self.inverse.start_from(v)

    def refine(self) -> None:
        """Do what the command did not have to wait for.

        Who has no time for it leaves it out: the next step learns what it has to, and a search
        for the gap pauses.
        """
        if self._lesson is not None:
            self._learn()
        self.estimator.refine()

    def _learn(self) -> None:
        lesson, self._lesson = self._lesson, None
        assert lesson is not None
        interval, applied = lesson.interval, lesson.applied
        for i in range(lesson.lost):
            passed = interval._replace(v=applied[i]) if applied else interval
            self.estimator.update(None, passed)
        self.lost_samples += lesson.lost
        self.estimator.update(
            lesson.y, interval._replace(v=applied[-1]) if applied else interval
        )
