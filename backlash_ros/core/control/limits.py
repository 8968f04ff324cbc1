"""Limits of v and of its motion, through which every command passes, the last ones included."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import copysign, floor, inf, isnan, sqrt
from typing import NamedTuple

from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.backlash import clamp

LARGEST_SIGNAL = 1e12  # no measurement is larger in any unit; its square is still finite


def plausible(value: float) -> bool:
    """Whether a value can be a measurement: neither nan nor larger than LARGEST_SIGNAL."""
    return abs(value) <= LARGEST_SIGNAL


class Motion(NamedTuple):
    """A command and its motion, in the unit of v."""

    v: float
    move: float = 0.0  # v(k) - v(k-1)
    target: float = 0.0  # the v that was asked for
    pace: float = 0.0  # move of the target since the sample before


def at_rest(v: float) -> Motion:
    return Motion(v, 0.0, v)


@dataclass(frozen=True)
class Limits:
    """Bounds of v [unit of v], of its move per sample, and of the change of that per sample."""

    low: float = -inf
    high: float = inf
    move: float = inf
    acceleration: float = inf

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ParameterError('control.min', self.low, f'must be < control.max={self.high!r}')

    @property
    def zero(self) -> float:
        """The v nearest to 0 within the bounds."""
        return min(max(0.0, self.low), self.high)

    def go_on_from(self, told: float, known: float | None) -> float:
        """Return the v that others report, clamped to the bounds extended to a `known` v."""
        low, high = (self.low, self.high) if known is None else (
            min(self.low, known), max(self.high, known))
        return min(max(told, low), high)

    def apply(self, v: float, before: Motion) -> Motion:
        """Return the permitted motion towards v: within the bounds, or on the way back into them.

        The command stays where it is if v is nan. With a finite acceleration it brakes in time for
        bounds and target, and follows a target that moves steadily without a lag.
        """
        # No sensor could follow a v beyond the largest measurement.
        target = clamp(clamp(before.v if isnan(v) else v, self.low, self.high),
                       -LARGEST_SIGNAL, LARGEST_SIGNAL)
        v, most = before.v, self.acceleration
        if most == inf:
            sent = clamp(target, v - self.move, v + self.move)
            return Motion(sent, sent - v, target)
        asked = pace = target - before.target
        if abs(pace) > self.move or abs(pace - before.pace) > most:
            pace = 0.0  # the target jumped: there is no steady motion to join
        # In the frame of a target that moves steadily, v has to come to rest.
        ahead = target - pace - v
        move = pace + (self._braking(ahead) if ahead > 0.0 else -self._braking(-ahead))
        move = min(max(move, -self.move), self.move)
        move = max(min(move, self._braking(self.high - v)), -self._braking(v - self.low))
        move = min(max(move, before.move - most), before.move + most)
        sent = v + move
        # Up to rounding, v has arrived.
        if abs(sent - target) <= 1e-14 * (abs(v) + abs(target)):
            sent = target
        return Motion(sent, move, target, asked)

    def stop(self, before: Motion) -> Motion:
        """Return the next motion when v stops as fast as the acceleration allows."""
        move = copysign(max(abs(before.move) - self.acceleration, 0.0), before.move)
        return Motion(before.v + move, move, before.v + move)

    def samples_across(self, distance: float) -> float:
        """Number of samples that v needs for a distance >= 0, from rest to rest."""
        if self.acceleration == inf:
            return distance / self.move
        fastest = min(self.move, sqrt(distance * self.acceleration))
        return distance / fastest + fastest / self.acceleration if fastest > 0.0 else 0.0

    def _braking(self, distance: float) -> float:
        """The largest move now after which v can still come to rest within a distance."""
        if distance < 0.0:  # beyond a bound, as after bounds were narrowed
            return -min(self._braking(-distance), self.move)
        # Slowed down by a per sample, a move of (n + f) a covers (n (n+1)/2 + (n+1) f) a in all.
        way = distance / self.acceleration
        if way == inf:
            return inf
        n = floor(0.5 * (sqrt(1.0 + 8.0 * way) - 1.0))
        return self.acceleration * (n + (way - 0.5 * n * (n + 1)) / (n + 1))


def last_commands(action: str, motion: Motion, limits: Callable[[], Limits]) -> Iterator[float]:
    """Yield the commands that end a motion, one per sample; the last one stays in force.

    action: 'hold' brings v to rest, 'zero' and 'ramp' to `Limits.zero` as fast as limits allow.
    """
    if action == 'hold':
        while (onward := limits().stop(motion)).v != motion.v:
            motion = onward
            yield motion.v
        return
    if action == 'zero' and motion.v == limits().zero:
        yield motion.v  # sent even though nothing changes
    while motion.v != limits().zero or (motion.move != 0.0 and limits().acceleration < inf):
        before, motion = motion, limits().apply(limits().zero, motion)
        if motion.v == before.v and motion.move == 0.0:
            return  # v is so large that a step at rate_max does not change it
        yield motion.v


def check_last_commands(p: Parameters) -> None:
    """Raise ParameterError if an action is 'ramp' while control.rate_max is infinite."""
    for name in ('on_stop', 'on_timeout'):
        if p[name] == 'ramp' and p.control.rate_max == inf:
            raise ParameterError(name, 'ramp', 'needs a finite control.rate_max',
                                 'set it, or take hold or zero')
