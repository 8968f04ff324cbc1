"""Motion of v that shows a backlash without hurting anybody: within a range, at limited speed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import inf, pi, sin

from backlash_ros.core.identification.motion import strokes
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError


@dataclass(frozen=True)
class Range:
    """Limits of v [unit of v] and of its speed [unit of v / s]."""

    low: float
    high: float
    rate: float

    @property
    def rest(self) -> float:
        """Where v ends: 0, or the limit next to it."""
        return min(max(0.0, self.low), self.high)


def drive_range(p: Parameters, amplitude: float | None, rate: float | None) -> Range:
    """What both the parameters and the options allow.

    Raises ParameterError where a limit is missing or the limits exclude each other.
    """
    excursion = inf if amplitude is None else amplitude
    low, high = max(p.control.min, -excursion), min(p.control.max, excursion)
    speed = min(p.control.rate_max, inf if rate is None else rate)
    for name, value, option in (
        ('control.min', low, '--amplitude'), ('control.max', high, '--amplitude'),
        ('control.rate_max', speed, '--rate'),
    ):
        if abs(value) == inf:
            raise ParameterError(
                name, value, 'is no limit to drive within', f'set {name}, or give {option}')
    if not low < high:
        raise ParameterError(
            'control.min', low, f'must be < control.max={high!r} within --amplitude={excursion:g}'
        )
    return Range(low, high, speed)


class Drive(ABC):
    """v(k) from one sample to the next within limits."""

    def __init__(self, limits: Range, sample_period: float, duration: float, v: float = 0.0,
                 ) -> None:
        self.limits, self.v = limits, v
        self._sample_period, self._duration = sample_period, duration

    @abstractmethod
    def step(self) -> float:
        """The next v."""

    def step_to_rest(self) -> bool:
        """Move v towards rest; return whether it has got there."""
        return self._towards(self.limits.rest) == self.limits.rest

    def _towards(self, target: float) -> float:
        move = self.limits.rate * self._sample_period
        self.v = min(max(target, self.v - move), self.v + move)
        return self.v


class GentleDrive(Drive):
    """To and fro along two sines."""

    _t = 0.0

    def step(self) -> float:
        """The next v, towards the wave."""
        low, high = self.limits.low, self.limits.high
        half = 0.5 * (high - low)
        # Together they tell a delay from a wider gap; three periods of the slower one.
        share, faster = 0.3, 2.7
        steepest = 1.0 - share + share * faster
        x = min(6.0 * pi / self._duration, self.limits.rate / (half * steepest)) * self._t
        target = 0.5 * (low + high) + half * (
            (1.0 - share) * sin(x) + share * sin(faster * x))
        # The wave waits where v has not got to its beginning yet.
        if self._towards(target) == target:
            self._t += self._sample_period
        return self.v


class IdentificationDrive(Drive):
    """Strokes of several speeds and amplitudes, with rests, as core/identification has them."""

    def __init__(self, limits: Range, sample_period: float, duration: float, v: float = 0.0,
                 ) -> None:
        super().__init__(limits, sample_period, duration, v)
        self._strokes = strokes(limits.low, limits.high, limits.rate, sample_period, duration, v)

    def step(self) -> float:
        """The next v."""
        return self._towards(next(self._strokes))
