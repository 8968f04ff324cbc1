"""Backlash, equation (2.1): play between an actuator and its load, per sample or over a record.

u = m (p - c_r) of a play p(k) = min(max(p(k-1), v(k)), v(k) + gap) with gap = c_r - c_l: p rests on
v while the right side is engaged, and on v + gap while the left one is.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.transfer_function import Array

Sides = NDArray[np.int8]


class Region(IntEnum):
    """Region of (2.1) that holds at a sample."""

    LEFT = -1  # downward active: u = m (v - c_l)
    GAP = 0  # u is held
    RIGHT = 1  # upward active: u = m (v - c_r)


LEFT, GAP, RIGHT = Region  # names of the module, as looking up a member of the class is slow


def clamp(held: float, low: float, high: float) -> float:
    """Return the held value, pushed along by the bound that it meets: one step of (2.1)."""
    return low if held <= low else high if held >= high else held


class Backlash:
    """Friction-driven hysteresis u = B[v] of slope m and crossings c_l < c_r, equation (2.1).

    m: slope, unit of u per unit of v. c_r, c_l: crossings of the v axis, unit of v.
    u: output held until v first reaches one of the two lines. Raises ParameterError.
    """

    def __init__(self, m: float, c_r: float, c_l: float, u: float = 0.0) -> None:
        if m <= 0.0:
            raise ParameterError('backlash.m', m, 'must be > 0')
        if c_l >= c_r:
            raise ParameterError('backlash.c_l', c_l, f'must be < backlash.c_r={c_r!r}',
                                 'the gap is c_r - c_l')
        self.m, self.c_r, self.c_l, self.u = m, c_r, c_l, u

    def step(self, v: float) -> float:
        """Move the input to v and return u(t)."""
        # c_l < c_r puts the upward line m (v - c_r) below the downward one, so that the three
        # cases of (2.1) are one clamp of u(t-1) between the two lines.
        self.u = clamp(self.u, self.m * (v - self.c_r), self.m * (v - self.c_l))
        return self.u


class Strokes(NamedTuple):
    """The strokes of v, from one turn to the next; play is stepped through their ends only."""

    rises: NDArray[np.bool_]  # whether v rises in the stroke of each sample (N,)
    ends: list[tuple[float, bool]]  # v at the end of each stroke, and whether v rises in it
    lengths: NDArray[np.intp]  # number of samples of each


def strokes_of(v: Array) -> Strokes:
    """Return the strokes of v (N,); the first sample belongs to the first of them."""
    rises = np.zeros(len(v), np.bool_)
    np.greater(v[1:], v[:-1], out=rises[1:])
    rises[:1] = rises[1:2].any()
    turns = np.append(np.flatnonzero(rises[1:] != rises[:-1]), len(v) - 1)
    ends = list(zip(v[turns].tolist(), rises[turns].tolist(), strict=True))
    return Strokes(rises, ends, np.diff(turns, prepend=-1))


def play(
    v: Array, gap: Array | float, before: Array | float, strokes: Strokes | None = None,
) -> Array:
    """Return p after each v (N,); before: p before the first. For H gaps and befores: (H, N).

    Within a stroke of v, p is the larger of v and the held value, or the smaller of that and
    v + gap. strokes: those of v, if they are known already.
    """
    rises, ends, lengths = strokes or strokes_of(v)
    many = isinstance(gap, np.ndarray)
    lower, upper = (np.minimum, np.maximum) if many else (min, max)
    first = float(v[0])
    held, at_turns = lower(upper(before, first), first + gap), []
    for value, rising in ends:
        at_turns.append(held)
        held = upper(held, value) if rising else lower(held, value + gap)
    p = np.repeat(np.array(at_turns).T, lengths, axis=-1)
    wide = gap[:, None] if isinstance(gap, np.ndarray) else gap
    return np.where(rises, np.maximum(p, v), np.minimum(p, v + wide))


def gap_variance(cov: Array) -> float:
    """Variance of c_r - c_l, given a covariance of m, c_r, c_l and any others after them."""
    return max(float(cov[1, 1] + cov[2, 2] - 2.0 * cov[1, 2]), 0.0)


def coasted(v: Array, p: Array, gap: float) -> Array:
    """How far a load that coasts freely in the gap gets ahead of p (N,), for v (N,)."""
    beyond, speed = [0.0], 0.0
    for k, move in enumerate(np.diff(p).tolist(), 1):
        speed = move or speed
        # It starts anew from the side that moves it, and stops at the other.
        away = 0.0 if move else clamp(beyond[-1] + speed, v[k] - p[k], v[k] + gap - p[k])
        beyond.append(away)
    return np.array(beyond)


def engaged(v: Array, p: Array, gap: float) -> Sides:
    """Return the side that was engaged last at each sample (N,); GAP before any was."""
    now = np.where(p == v, Region.RIGHT, np.where(p == v + gap, Region.LEFT, Region.GAP))
    newest = np.maximum.accumulate(np.where(now != Region.GAP, np.arange(len(v)), -1))
    return np.where(newest < 0, Region.GAP, now[newest]).astype(np.int8)


def reversals(sides: Sides) -> NDArray[np.intp]:
    """Return the samples (R,) at which the other side engages."""
    seen = np.flatnonzero(sides)
    return np.asarray(seen[1:][np.diff(sides[seen]) != 0])
