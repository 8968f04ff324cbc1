"""Whether a residual is noise: what a wrong model leaves follows the motion, at whatever lag.

The error terms of G can whiten the residual from one sample to the next and leave it correlated
over two or eight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import LAGS


def largest_correlation(residual: NDArray[np.float64]) -> float:
    """Largest correlation of a residual (N,), not all 0, with itself some samples before."""
    squares = float(residual @ residual)
    return max(float(residual[lag:] @ residual[:-lag]) / squares for lag in LAGS)
