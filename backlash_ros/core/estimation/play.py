"""The play operator over a record: p(k) = min(max(p(k-1), v(k)), v(k) + gap).

u = m (p - c_r) is the output of the backlash (2.1) with the gap c_r - c_l; p rests on v while the
right side is engaged, and on v + gap while the left one is. Beside it, a disturbance of u may walk.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Sides = NDArray[np.int8]

RIGHT, LEFT, NEITHER = 1, -1, 0  # side of the gap that was engaged last


def play(v: Array, gap: float, before: float) -> Array:
    """p after each v (N,); before: p before the first of them.

    Between two turns of v, p is the larger of v and what was held, or the smaller of v + gap and
    it: only the turns are stepped.
    """
    rises, last = _turns(v)
    held, at_turns = min(max(before, v[0]), v[0] + gap), []
    for value, rising in zip(v[last].tolist(), rises[last].tolist(), strict=True):
        at_turns.append(held)
        held = max(held, value) if rising else min(held, value + gap)
    return _between(v, rises, last, np.array(at_turns), gap)


def plays(v: Array, gaps: Array, before: Array) -> Array:
    """The same for many gaps (H,) and beginnings (H,) at once, shape (H, N)."""
    rises, last = _turns(v)
    held = np.minimum(np.maximum(before, v[0]), v[0] + gaps)
    at_turns = np.empty((len(gaps), len(last)))
    for k, (value, rising) in enumerate(zip(v[last].tolist(), rises[last].tolist(), strict=True)):
        at_turns[:, k] = held
        held = np.maximum(held, value) if rising else np.minimum(held, value + gaps)
    return _between(v, rises, last, at_turns, gaps[:, None])


def _turns(v: Array) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Whether v rises to each sample (N,), and the last samples before it does otherwise."""
    rises = np.append(False, v[1:] > v[:-1])
    return rises, np.append(np.flatnonzero(rises[1:] != rises[:-1]), len(v) - 1)


def _between(
    v: Array, rises: NDArray[np.bool_], last: NDArray[np.intp], held: Array, gap: Array | float,
) -> Array:
    """p (..., N), from what was held (..., T) before each of the turns."""
    p = np.repeat(held, np.diff(last, prepend=-1), axis=-1)
    return np.where(rises, np.maximum(p, v), np.minimum(p, v + gap))


def engaged(v: Array, p: Array, gap: float) -> Sides:
    """The side that was engaged last at each sample (N,): RIGHT, LEFT, NEITHER before the first."""
    now = np.where(p == v, RIGHT, np.where(p == v + gap, LEFT, NEITHER)).astype(np.int8)
    newest = np.maximum.accumulate(np.where(now != NEITHER, np.arange(len(v)), -1))
    return np.where(newest < 0, np.int8(NEITHER), now[newest])


def reversals(sides: Sides) -> NDArray[np.intp]:
    """Samples (R,) at which the other side engages."""
    seen = np.flatnonzero(sides != NEITHER)
    return np.asarray(seen[1:][np.diff(sides[seen]) != 0])


def walk(knots: Array, count: int) -> Array:
    """d (count,) of these knots (W,): straight from one to the next, and to 0 at the end."""
    at = np.linspace(0.0, count - 1.0, len(knots) + 1)
    return np.asarray(np.interp(np.arange(count), at, np.append(knots, 0.0)))


def hats(count: int) -> Array:
    """How d depends on its knots, shape (W, count)."""
    knots = min(max(count // 8, 1), 36)  # so many samples apart at least, so many at most
    return np.array([walk(row, count) for row in np.eye(knots)])
