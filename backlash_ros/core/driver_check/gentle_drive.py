"""Motion of v that shows a backlash without hurting anybody: within a range, at limited speed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import inf, pi, sin

from backlash_ros.core.identification.motion import strokes
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError

PERIODS = 3.0  # of the slower sine, where the speed allows them
SHARE, FASTER = 0.3, 2.7  # of the second sine; together they tell a delay from a wider gap
STEEPEST = 1.0 - SHARE + SHARE * FASTER  # slope of both together, in that of one of amplitude 1


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
    low, high = (
        max(p.control.min, -excursion),
        min(p.control.max, excursion),
    )
    speed = min(p.control.rate_max, inf if rate is None else rate)
    for name, value in (('control.min', low), ('control.max', high)):
        if abs(value) == inf:
            raise ParameterError(
                name, value, 'is no limit to drive within', f'set {name}, or give --amplitude'
            )
    if speed == inf:
        raise ParameterError(
            'control.rate_max', speed, 'is no limit to drive within',
            'set control.rate_max, or give --rate',
        )
    if not low < high:
        raise ParameterError(
            'control.min', low, f'must be < control.max={high!r} within --amplitude={excursion:g}'
        )
    return Range(low, high, speed)


class Drive(ABC):
    """v(k) from one sample to the next within limits."""

    def __init__(self, limits: Range, sample_period: float, v: float) -> None:
        self.limits, self.v = limits, v
        self._sample_period = sample_period
        self._move = limits.rate * sample_period

    @abstractmethod
    def step(self) -> float:
        """The next v."""

    def step_to_rest(self) -> bool:
        """Move v towards rest; return whether it has got there."""
        return self._towards(self.limits.rest) == self.limits.rest

    def _towards(self, target: float) -> float:
        self.v = min(max(target, self.v - self._move), self.v + self._move)
        return self.v


class GentleDrive(Drive):
    """To and fro along two sines."""

    def __init__(
        self, limits: Range, sample_period: float, duration: float, v: float = 0.0,
    ) -> None:
        super().__init__(limits, sample_period, v)
        self._t = 0.0
        half = 0.5 * (limits.high - limits.low)
        self._speed = min(2.0 * pi * PERIODS / duration, limits.rate / (half * STEEPEST))

    def step(self) -> float:
        """The next v, towards the wave."""
        target = self._wave()
        v = self._towards(target)
        # The wave waits where v has not got to its beginning yet.
        if v == target:
            self._t += self._sample_period
        return v

    def _wave(self) -> float:
        low, high = self.limits.low, self.limits.high
        x = self._speed * self._t
        swing = (1.0 - SHARE) * sin(x) + SHARE * sin(FASTER * x)
        return 0.5 * (low + high) + 0.5 * (high - low) * swing


class IdentificationDrive(Drive):
    """Strokes of several speeds and amplitudes, with rests, as core/identification has them."""

    def __init__(
        self, limits: Range, sample_period: float, duration: float, v: float = 0.0,
    ) -> None:
        super().__init__(limits, sample_period, v)
        self._strokes = strokes(
            limits.low, limits.high, limits.rate, sample_period, duration, v
        )

    def step(self) -> float:
        """The next v."""
        return self._towards(next(self._strokes))
