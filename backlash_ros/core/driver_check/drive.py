"""Motion of v that shows a backlash without hurting anybody: within a range, at limited speed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf, pi, sin

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


# Low, high, rate of a Range, sample period [s], duration [s] and first v of a motion to its v(k).
Motion = Callable[[float, float, float, float, float, float], Iterator[float]]


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


class Drive:
    """v(k) from one sample to the next along a motion, within limits."""

    def __init__(
        self, motion: Motion, limits: Range, sample_period: float, duration: float, v: float = 0.0,
    ) -> None:
        self.limits, self.v = limits, v
        self._move = limits.rate * sample_period
        self._motion = motion(limits.low, limits.high, limits.rate, sample_period, duration, v)

    def step(self) -> float:
        """The next v."""
        return self._towards(next(self._motion))

    def step_to_rest(self) -> bool:
        """Move v towards rest; return whether it has got there."""
        return self._towards(self.limits.rest) == self.limits.rest

    def _towards(self, target: float) -> float:
        self.v = min(max(target, self.v - self._move), self.v + self._move)
        return self.v


def waves(
    low: float, high: float, rate: float, period: float, duration: float, v: float,
) -> Iterator[float]:
    """To and fro along two sines from the middle of the range on, as soon as v has got there."""
    middle, half, move = 0.5 * (low + high), 0.5 * (high - low), rate * period
    while abs(v - middle) > move:
        v += move if v < middle else -move
        yield v
    # Together they tell a delay from a wider gap; three periods of the slower one.
    share, faster = 0.3, 2.7
    x, step = 0.0, period * min(
        6.0 * pi / duration, rate / (half * (1.0 - share + share * faster)))
    while True:
        yield middle + half * ((1.0 - share) * sin(x) + share * sin(faster * x))
        x += step
