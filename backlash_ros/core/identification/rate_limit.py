"""A drive that moves at a speed of its own: v jumps, and what reaches the play follows as a ramp.

Position servos with a speed profile, motorised valves and dampers do so. A linear G cannot explain
it, and fits a gap to what is left over. As y goes on while v is at rest, it also looks like a load
that something else moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.linear_family import LinearFamily, centred

Array = NDArray[np.float64]

JUMP = 0.05  # step of v that a drive may be too slow for [swing of v]


def limited(v: Array, step: float) -> Array:
    """v (N,), followed with steps of at most so much."""
    step, place, out = abs(step), float(v[0]), []
    for value in v.tolist():
        place += min(max(value - place, -step), step)
        out.append(place)
    return np.array(out)


def rate_limit(v: Array, y: Array) -> float | None:
    """Largest step of v (N,) that a drive followed, as y (N,) shows, nan where lost.

    None where a play explains y without such a limit, or v never jumps.
    """
    family = LinearFamily(v, y)
    largest = float(np.max(np.abs(np.diff(family.v)), initial=0.0))
    if largest < JUMP or len(family.rows) < 100:
        return None
    play = family.best(centred, [(width,) for width in (6e-4, 0.01, 0.1, 0.3)])

    def following(v: Array, octaves: float, width: float) -> Array:
        return centred(limited(v, largest * 2.0**octaves), width)

    slow = family.best(following, [
        (octaves, width) for octaves in (-1.0, -2.5, -4.0, -6.0) for width in (0.003, 0.03)])
    # Nothing is known of the noise yet: it counts as left over.
    if not family.beats(slow, play, 0.0):
        return None
    # Along a ramp, a small error of its slope adds up.
    octaves = family.best(following, [slow.at]).at[0]
    return float(family.swing * largest * 2.0**octaves)
