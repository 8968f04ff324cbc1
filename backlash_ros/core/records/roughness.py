"""How rough a signal is over its instants: what noise it has, and which instants are the true ones.

A smooth motion is predicted from its neighbours; instants that are not the true ones make it rough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.records.samples import TO_STD

Array = NDArray[np.float64]

FEWEST_VALUES = 20  # that tell anything


def _residuals(t: Array, s: Array, reach: int) -> Array:
    """Error of predicting each value from `reach` neighbours on each side, per unit of noise."""
    if len(s) < FEWEST_VALUES:
        return np.empty(0)
    t = t - t[0]
    sides = [*range(-reach, 0), *range(1, reach + 1)]
    at = np.arange(reach, len(t) - reach)
    # Neighbours that are nearly at one place predict nothing.
    apart = np.min([t[at + j + 1] - t[at + j] for j in range(-reach, reach)], axis=0)
    at = at[apart > 0.05 * t[-1] / (len(t) - 1)]
    predicted, variance = np.zeros(len(at)), np.ones(len(at))
    for j in sides:
        weight = np.prod(
            [(t[at] - t[at + i]) / (t[at + j] - t[at + i]) for i in sides if i != j], axis=0)
        predicted += weight * s[at + j]
        variance += weight**2
    return np.asarray((s[at] - predicted) / np.sqrt(variance))


def noise_of(t: Array, y: Array) -> float:
    """Deviation of the noise of y (N,) at t (N,), both finite, from cubic predictions; 0 if few."""
    errors = np.abs(_residuals(t, y, 2))
    return TO_STD * float(np.median(errors)) if len(errors) else 0.0


def curvature_of(t: Array, y: Array, noise: float) -> float:
    """Error of reading y (N,) off the line between two neighbours, midway, beyond the noise."""
    errors = _residuals(t, y, 1)
    # Per unit of noise the prediction from both sides has 1 + 1/2; and neighbours on both sides are
    # twice as far apart as two of one line.
    square = 1.5 * (float(np.mean(errors**2)) - noise**2) if len(errors) else 0.0
    return 0.25 * float(np.sqrt(max(square, 0.0)))


def rougher(t: Array, other: Array, signal: Array) -> float:
    """Log of how much rougher a signal (N,) is over the instants t than over the other ones (N,).

    0 where too few values tell.
    """
    known = np.isfinite(signal)
    squares = [_residuals(each[known], signal[known], 1)**2 for each in (t, other)]
    if min(map(len, squares)) < FEWEST_VALUES:
        return 0.0
    # Steps are as rough over any instants.
    sizes = [float(np.mean(np.minimum(each, np.percentile(each, 98.0)))) for each in squares]
    return 0.5 * float(np.log(sizes[0] / sizes[1])) if min(sizes) > 0.0 else 0.0
