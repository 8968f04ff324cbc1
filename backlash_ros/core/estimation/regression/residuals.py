"""Whether a residual is noise, and how large the noise in it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NORMAL_MAD = 1.4826  # standard deviation of a normal distribution with a median of |x| of 1


def largest_correlation(residual: NDArray[np.float64], lags: Sequence[int]) -> float:
    """Largest correlation of a residual (N,), not all 0, with itself so many samples before.

    What a wrong model leaves follows the motion, at whatever lag: the error terms of G can whiten
    the residual from one sample to the next and leave it correlated over two or eight.
    """
    squares = float(residual @ residual)
    return max(float(residual[lag:] @ residual[:-lag]) / squares for lag in lags)


def bulk_std(residual: NDArray[np.float64]) -> float:
    """Standard deviation of normal values (N,), at least one; outliers do not widen it."""
    return NORMAL_MAD * float(np.median(np.abs(residual)))
