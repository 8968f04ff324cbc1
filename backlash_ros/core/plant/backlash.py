"""Backlash, equation (2.1): play between an actuator and what it drives."""

from enum import IntEnum
from math import isfinite

from backlash_ros.core.parameters.errors import ParameterError


class Region(IntEnum):
    """Region of (2.1) that holds at a sample."""

    LEFT = -1  # downward active: u = m (v - c_l)
    GAP = 0  # u is held
    RIGHT = 1  # upward active: u = m (v - c_r)


def clamp(held: float, low: float, high: float) -> float:
    """What a play holds: the value before, moved by the wall that it meets, (2.1)."""
    return low if held <= low else high if held >= high else held


class Backlash:
    """Friction-driven hysteresis u = B[v] of slope m and crossings c_l < c_r, equation (2.1).

    m: slope, unit of u per unit of v. c_r, c_l: crossings of the v axis, unit of v.
    u: output held until v first reaches one of the two lines. Raises ParameterError.
    """

    def __init__(self, m: float, c_r: float, c_l: float, u: float = 0.0) -> None:
        for name, value in (('m', m), ('c_r', c_r), ('c_l', c_l), ('initial_u', u)):
            if not isfinite(value):
                raise ParameterError(f'backlash.{name}', value, 'must be finite')
        if m <= 0.0:
            raise ParameterError('backlash.m', m, 'must be > 0')
        if c_l >= c_r:
            raise ParameterError('backlash.c_l', c_l, f'must be < backlash.c_r={c_r!r}',
                                 'the gap is c_r - c_l')
        self.m, self.c_r, self.c_l, self.u = m, c_r, c_l, u
        self.region = Region.GAP

    def step(self, v: float) -> float:
        """Move the input to v and return u(t)."""
        # c_l < c_r puts the upward line m (v - c_r) below the downward one, so that the three
        # cases of (2.1) are one clamp of u(t-1) between the two lines.
        upward, downward = self.m * (v - self.c_r), self.m * (v - self.c_l)
        self.u = clamp(self.u, upward, downward)
        self.region = Region.RIGHT if self.u == upward else \
            Region.LEFT if self.u == downward else Region.GAP
        return self.u
