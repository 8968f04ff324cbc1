"""How rough a signal is over its instants: what noise it has, and which instants are the true ones.

A smooth motion is predicted from its neighbours; instants that are not the true ones make it rough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.records.samples import TO_STD

Array = NDArray[np.float64]

FEWEST = 20  # readings that tell anything
CLOSE = 0.05  # of the mean distance: neighbours closer than this predict nothing


def _residuals(t: Array, s: Array, reach: int) -> Array:
    """Error of predicting each value from `reach` neighbours on each side, per unit of noise."""
    t = t - t[0]
    places = [*range(-reach, 0), *range(1, reach + 1)]
    middle = np.arange(reach, len(t) - reach)
    around = np.stack([t[middle + j] for j in places])
    values = np.stack([s[middle + j] for j in places])
    x = t[middle]
    mean = (t[-1] - t[0]) / max(len(t) - 1, 1)
    apart = np.diff(np.vstack([around[:reach], x[None], around[reach:]]), axis=0).min(axis=0)
    good = apart > CLOSE * mean
    around, values, x, middle = around[:, good], values[:, good], x[good], middle[good]
    weights = np.ones_like(around)
    for j in range(len(places)):
        for other in range(len(places)):
            if other != j:
                weights[j] *= (x - around[other]) / (around[j] - around[other])
    norm = np.sqrt(1.0 + (weights**2).sum(axis=0))
    return np.asarray((s[middle] - (weights * values).sum(axis=0)) / norm)


def noise_of(t: Array, y: Array) -> float:
    """Deviation of the noise of y (N,) at t (N,), both finite, from cubic predictions; 0 if few."""
    if len(y) < FEWEST:
        return 0.0
    errors = np.abs(_residuals(t, y, 2))
    return TO_STD * float(np.median(errors)) if len(errors) else 0.0


def curvature_of(t: Array, y: Array, noise: float) -> float:
    """Error of reading y (N,) off the line between two neighbours, midway, beyond the noise."""
    if len(y) < FEWEST:
        return 0.0
    errors = _residuals(t, y, 1)
    # Per unit of noise: the prediction from both sides has 1 + 1/2.
    mean_square = 1.5 * float(np.mean(errors**2)) - 1.5 * noise**2 if len(errors) else 0.0
    # Neighbours on both sides are twice as far apart as two of one line.
    return 0.25 * float(np.sqrt(max(mean_square, 0.0)))


def rougher(t: Array, other: Array, signal: Array) -> float:
    """Log of how much rougher a signal (N,) is over the instants t than over the other ones (N,).

    0 where too few values tell.
    """
    known = np.isfinite(signal)
    if np.count_nonzero(known) < FEWEST:
        return 0.0
    sizes = []
    for instants in (t, other):
        errors = _residuals(instants[known], signal[known], 1) ** 2
        if len(errors) < FEWEST:
            return 0.0
        # Steps are as rough over any instants.
        sizes.append(float(np.mean(np.minimum(errors, np.percentile(errors, 98.0)))))
    if min(sizes) <= 0.0:
        return 0.0
    return 0.5 * float(np.log(sizes[0] / sizes[1]))
