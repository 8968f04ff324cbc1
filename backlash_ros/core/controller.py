"""The adaptive backlash inverse controller: estimator, structure, inverse and limits."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.estimator import Estimate, Estimator, Interval
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.structure import Situation, Structure


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

    def apply(self, v: float, v_before: float) -> float:
        """v within the bounds and not too far from v_before."""
        v = min(max(v, v_before - self.move), v_before + self.move)
        return min(max(v, self.low), self.high)


@dataclass(frozen=True)
class ControlStep:
    """What one sample made: the command, and the estimate it was computed with."""

    y_m: float
    y: float
    u_d: float
    v: float
    u_hat: float
    innovation: float
    estimate: Estimate


class AdaptiveController:
    """Learns the backlash from v and y and publishes v = BI(u_d), section 3 of the paper.

    Call `step` once per received y. The estimator is updated before v is computed, so that
    v(k) uses everything up to y(k).
    """

    def __init__(
        self, estimator: Estimator, structure: Structure, inverse: BacklashInverse,
        limits: Limits,
    ) -> None:
        self.estimator, self.structure = estimator, structure
        self.inverse, self.limits = inverse, limits
        self.lost_samples = 0
        self._interval: Interval | None = None

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: float | None = None,
    ) -> ControlStep:
        """Return the command for sample k.

        y, y_m: output and reference, finite. lost: samples that never arrived since the last
        call; the plant went on with the last v through all of them. applied: the v that was
        really applied since then, if it is known.
        """
        if not (isfinite(y) and isfinite(y_m)):
            raise ValueError(f'y={y!r} and y_m={y_m!r} must be finite')
        estimator = self.estimator
        interval = self._interval
        if interval is not None:
            if applied is not None:
                interval = Interval(applied, interval.y_m, interval.u_d, interval.f)
            for _ in range(lost):
                estimator.update(None, interval)
            self.lost_samples += lost
            estimator.update(y, interval)
        inverse = self.inverse
        v_before = inverse.v
        situation = Situation(y_m, y, estimator.estimate, estimator.x_hat, estimator.x_cov)
        command = self.structure.control(situation, inverse)
        v = self.limits.apply(command.v, v_before)
        inverse.applied(v)
        self._interval = Interval(v, y_m, command.u_d, command.f)
        return ControlStep(
            y_m, y, command.u_d, v, estimator.u_hat, estimator.innovation, estimator.estimate
        )
