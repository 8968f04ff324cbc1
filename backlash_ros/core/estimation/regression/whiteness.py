"""Whether a residual is noise: what a wrong model leaves follows the motion, at whatever lag.

The error terms of G can whiten the residual from one sample to the next and leave it correlated
over two or eight.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def largest_correlation(residual: NDArray[np.float64], lags: Sequence[int]) -> float:
    """Largest correlation of a residual (N,), not all 0, with itself so many samples before."""
    squares = float(residual @ residual)
    return max(float(residual[lag:] @ residual[:-lag]) / squares for lag in lags)
