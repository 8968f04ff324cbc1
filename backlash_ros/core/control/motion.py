"""Motion of v that reveals a backlash safely: within a range and at limited speed.

It has several speeds, amplitudes and rests, in both directions: a lag looks like a gap that grows
with the speed, so at a single speed the two could not be told apart.
"""

from collections.abc import Iterator
from itertools import count
from math import inf

from backlash_ros.core.control.limits import Limits, at_rest, last_commands
from backlash_ros.core.parameters import ParameterError, Parameters


def drive_limits(p: Parameters, amplitude: float | None, rate: float | None) -> Limits:
    """Return the limits that both the parameters and the command-line options allow.

    Raises ParameterError if a limit is missing or no range is left.
    """
    excursion, period = inf if amplitude is None else amplitude, p.sample_period
    low, high = max(p.control.min, -excursion), min(p.control.max, excursion)
    speed = min(p.control.rate_max, inf if rate is None else rate)
    for name, value, option in (
        ('control.min', low, '--amplitude'), ('control.max', high, '--amplitude'),
        ('control.rate_max', speed, '--rate'),
    ):
        if abs(value) == inf:
            raise ParameterError(
                name, value, 'must be finite to drive v', f'set {name}, or give {option}')
    if not low < high:
        raise ParameterError('control.min', low, f'must be < control.max={high!r} within '
                             f'--amplitude={excursion:g}')
    return Limits(low, high, speed * period, p.control.acceleration_max * period**2)


class Drive:
    """Makes v(k) along `strokes`, from a starting v, within limits."""

    def __init__(
        self, limits: Limits, sample_period: float, duration: float, v: float = 0.0,
    ) -> None:
        self._limits, self._motion = limits, at_rest(v)
        self._strokes = strokes(limits.low, limits.high, limits.move / sample_period,
                                sample_period, duration, v)

    def step(self) -> float:
        """Return the next v."""
        self._motion = self._limits.apply(next(self._strokes), self._motion)
        return self._motion.v

    def to_rest(self) -> Iterator[float]:
        """Yield v from here to 0, or to the bound nearest to 0, where it stays."""
        return last_commands('ramp', self._motion, lambda: self._limits)


def strokes(
    low: float, high: float, rate: float, period: float, duration: float, v: float,
) -> Iterator[float]:
    """Yield v(k) without end: strokes at up to the speed limit, some 24 across the range within
    the duration [s], with rests between them, in which the fast modes of G show."""
    golden, silver, bronze = 0.6180339887, 0.4142135624, 0.3027756377  # spread evenly, never repeat
    ordinary = min(rate, 24.0 * (high - low) / duration)
    up = v <= 0.5 * (low + high)
    for k in count():
        # Two full strokes, as a gap may be nearly as wide as the range, then two short ones.
        part = 1.0 if k % 4 < 2 else 0.35 + 0.55 * (k * golden % 1.0)
        target = v + part * ((high - v) if up else (low - v))
        target = min(max(target, low), high)  # despite rounding
        # Every third stroke is as fast as the actuator may move.
        move = period * (rate if k % 3 == 2 else ordinary * 0.15 ** ((0.13 + k * silver) % 1.0))
        while v != target:
            v = min(v + move, target) if v < target else max(v - move, target)
            yield v
        rest = (0.0, 0.1, 0.35)[int(3 * (k * bronze % 1.0))] * (high - low) / ordinary
        for _ in range(round(rest / period)):
            yield v
        up = not up
