"""Motion of v that shows a backlash without hurting anybody: within a range, at limited speed.

At several speeds, amplitudes and rests, in both directions: a lag shows as a gap that grows with
the speed, and with one speed only, they could not be told apart.
"""

from collections.abc import Iterator
from itertools import count
from math import inf

from backlash_ros.core.control.limits import Limits, at_rest, last_commands
from backlash_ros.core.parameters import ParameterError, Parameters


def drive_limits(p: Parameters, amplitude: float | None, rate: float | None) -> Limits:
    """What both the parameters and the options allow.

    Raises ParameterError where a limit is missing or the limits exclude each other.
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
                name, value, 'is no limit to drive within', f'set {name}, or give {option}')
    if not low < high:
        raise ParameterError('control.min', low, f'must be < control.max={high!r} within '
                             f'--amplitude={excursion:g}')
    return Limits(low, high, speed * period, p.control.acceleration_max * period**2)


class Drive:
    """v(k) along strokes, from v on, within limits."""

    def __init__(
        self, limits: Limits, sample_period: float, duration: float, v: float = 0.0,
    ) -> None:
        self._limits, self._motion = limits, at_rest(v)
        self._strokes = strokes(limits.low, limits.high, limits.move / sample_period,
                                sample_period, duration, v)

    def step(self) -> float:
        """The next v."""
        self._motion = self._limits.apply(next(self._strokes), self._motion)
        return self._motion.v

    def to_rest(self) -> Iterator[float]:
        """v from here to 0, or to the limit next to it, where it stays."""
        return last_commands('ramp', self._motion, lambda: self._limits)


def strokes(
    low: float, high: float, rate: float, period: float, duration: float, v: float,
) -> Iterator[float]:
    """v(k), one per sample, without end: strokes at up to the speed limit, with rests between,
    which show what is fast in G; some 24 across the range within the duration [s]."""
    golden, silver, bronze = 0.6180339887, 0.4142135624, 0.3027756377  # spread evenly, never repeat
    ordinary = min(rate, 24.0 * (high - low) / duration)
    up = v <= 0.5 * (low + high)
    for k in count():
        # Two strokes from end to end, for a gap may be nearly as wide, then two short ones.
        part = 1.0 if k % 4 < 2 else 0.35 + 0.55 * (k * golden % 1.0)
        target = v + part * ((high - v) if up else (low - v))
        target = min(max(target, low), high)  # whatever rounding does
        # Every third is as fast as the actuator may move.
        move = period * (rate if k % 3 == 2 else ordinary * 0.15 ** ((0.13 + k * silver) % 1.0))
        while v != target:
            v = min(v + move, target) if v < target else max(v - move, target)
            yield v
        rest = (0.0, 0.1, 0.35)[int(3 * (k * bronze % 1.0))] * (high - low) / ordinary
        for _ in range(round(rest / period)):
            yield v
        up = not up
