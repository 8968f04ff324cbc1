"""Which gaps are tried: a grid over all, and narrow ranges around an estimate."""

from __future__ import annotations

from math import ceil, log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.crossings import Crossings

Array = NDArray[np.float64]

GRID_RATIO = 1.2  # between neighbouring gaps of the coarse grid
SMALLEST_GAP = 5e-4  # of the widest gap the bounds allow
FINE = 7  # hypotheses of a fine bank
REACH = 2.0  # standard deviations of the gap that a fine bank reaches to either side
LARGEST_SPREAD = 0.3  # of the gap: the standard deviation is not to be trusted beyond
# Gaps tried beyond the first or last one of a fine bank, if that one is the most likely, in terms
# of it.
OUTWARD, INWARD = 1.9, 0.9


def coarse_gaps(widest: float) -> Array:
    """Gaps of the coarse bank, ascending up to the widest one."""
    steps = ceil(-log(SMALLEST_GAP) / log(GRID_RATIO))
    return np.asarray(widest * SMALLEST_GAP ** np.linspace(1.0, 0.0, steps + 1), dtype=np.float64)


def bracket(gaps: Array, leader: int) -> Array:
    """Gaps between the neighbours of the leader, should its estimate of the gap mislead."""
    low = gaps[leader - 1] if leader > 0 and gaps[leader - 1] > 0.0 else 0.9 * gaps[leader]
    high = gaps[leader + 1] if leader + 1 < len(gaps) else 1.1 * gaps[leader]
    shares = np.array([-0.7, -0.35, 0.0, 0.35, 0.7])
    reach = np.where(shares < 0.0, gaps[leader] - low, high - gaps[leader])
    return np.asarray(gaps[leader] + shares * reach)


def beyond(gaps: Array, leader: int) -> Array:
    """Gaps on the far side of a leader that is the first or the last one."""
    reach = (1.0 / OUTWARD, 1.0 / INWARD) if leader == 0 else (INWARD, OUTWARD)
    return np.asarray(gaps[leader] * np.geomspace(*reach, FINE))


def fine_gaps(found: Crossings, count: int) -> Array:
    """Gaps of a fine bank around an estimate, ascending and > 0."""
    least = 1e-3 * found.std_gap
    gap = max(found.gap, least)
    spread = min(REACH * found.std_gap, max(LARGEST_SPREAD * gap, found.std_gap))
    return np.asarray(np.maximum(gap + spread * np.linspace(-1.0, 1.0, count), least))
