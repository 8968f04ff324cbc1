"""The adaptive backlash inverse controller: estimator, structure, inverse and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isnan
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
        """What may be sent instead of v after v_before: every command passes through here, last.

        It is within the bounds, or as far on the way to them as one sample allows; v_before stays
        where v is no number.
        """
        if self.low <= v <= self.high and abs(v - v_before) <= self.move and abs(v) <= LARGEST:
            return v
        if isnan(v):
            v = v_before
        # Beyond the largest measurement nobody could tell what v does.
        v = min(max(v, self.low, -LARGEST), self.high, LARGEST)
        return min(max(v, v_before - self.move), v_before + self.move)


class ControlStep(NamedTuple):
    """What one sample made: the command, and the estimate it was computed with."""

    y_m: float
    y: float
    u_d: float
    v: float
    estimate: Estimate


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
        # y(k), the interval before it, samples lost before it and what was applied, as long as
        # it is still to be learned from.
        self._lesson: tuple[float, Interval, int, Sequence[float]] | None = None

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
    ) -> ControlStep:
        """Return the command for sample k.

        y, y_m: output and reference, finite. lost: samples that never arrived since the last
        call; the plant went on with the last v through all of them. applied: the v that was
        really applied in each of the lost + 1 intervals since then, if it is known.
        """
        if not (-LARGEST <= y <= LARGEST and -LARGEST <= y_m <= LARGEST) or (
            applied and not all(map(plausible, applied))
        ):
            raise ValueError(
                f'y={y!r}, y_m={y_m!r} and applied={applied!r} must be finite and no larger than '
                f'{LARGEST:g}'
            )
        if lost < 0 or (applied and len(applied) != lost + 1):
            raise ValueError(f'lost={lost!r} must be >= 0 and applied have lost + 1 values')
        if self._lesson is not None:
            self._learn()
        if self._interval is not None:
            self._lesson = y, self._interval, lost, applied
            if self.structure.needs_output:
                self._learn()
        estimator, inverse = self.estimator, self.inverse
        used = estimate = estimator.estimate
        if not self.compensating:
            used = replace(estimate, c_r=0.0, c_l=0.0)
        v_before = inverse.v
        u_d, v, f = self.structure.control(Situation(y_m, y, used, estimator), inverse)
        v = self.limits.apply(v, v_before)
        inverse.applied(v)
        self._interval = Interval(v, y_m, u_d, f)
        return ControlStep(y_m, y, u_d, v, estimate)

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
        y, interval, lost, applied = lesson
        for i in range(lost):
            passed = interval._replace(v=applied[i]) if applied else interval
            self.estimator.update(None, passed)
        self.lost_samples += lost
        self.estimator.update(y, interval._replace(v=applied[-1]) if applied else interval)
