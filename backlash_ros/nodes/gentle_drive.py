"""Motion of v that shows a backlash without hurting anybody: within a range, at limited speed."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi, sin

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.parameters import Parameters

PERIODS = 3.0  # of the slower sine, where the speed allows them
SHARE, FASTER = 0.3, 2.7  # of the second sine; together they tell a delay from a wider gap
STEEPEST = 1.0 - SHARE + SHARE * FASTER
STEPS = 24  # on the way up; each shows the response of G at all frequencies
UNEVEN = 0.618  # share of a step by which their times differ, lest they excite one frequency only


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
    reach = inf if amplitude is None else amplitude
    low, high = max(p.real('control.min'), -reach), min(p.real('control.max'), reach)
    speed = min(p.real('control.rate_max'), inf if rate is None else rate)
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
            'control.min', low, f'must be < control.max={high!r} within --amplitude={reach:g}'
        )
    return Range(low, high, speed)


class GentleDrive:
    """v(k) from one sample to the next.

    rising: once from the lower to the upper limit, step by step, instead of to and fro.
    """

    def __init__(
        self, limits: Range, sample_period: float, duration: float, rising: bool = False,
        v: float = 0.0,
    ) -> None:
        self.limits, self.v = limits, v
        self._move = limits.rate * sample_period
        self._sample_period, self._rising = sample_period, rising
        self._t = 0.0
        half = 0.5 * (limits.high - limits.low)
        if rising:
            self._speed = 1.0 / max(duration - 2.0 * half / limits.rate, sample_period)
        else:
            self._speed = min(2.0 * pi * PERIODS / duration, limits.rate / (half * STEEPEST))

    def step(self) -> float:
        """The next v, towards the wave."""
        target = self._wave()
        v = self._towards(target)
        # The wave waits where v has not got to its beginning yet.
        if v == target:
            self._t += self._sample_period
        return v

    def step_to_rest(self) -> bool:
        """Move v towards rest; return whether it has got there."""
        return self._towards(self.limits.rest) == self.limits.rest

    def _towards(self, target: float) -> float:
        self.v = min(max(target, self.v - self._move), self.v + self._move)
        return self.v

    def _wave(self) -> float:
        low, high = self.limits.low, self.limits.high
        x = self._speed * self._t
        if self._rising:
            steps = STEPS * min(x, 1.0)
            number = int(steps)
            up = number + (steps - number > UNEVEN * (number * UNEVEN % 1.0))
            return low + (high - low) * min(up / STEPS, 1.0)
        swing = (1.0 - SHARE) * sin(x) + SHARE * sin(FASTER * x)
        return 0.5 * (low + high) + 0.5 * (high - low) * swing
