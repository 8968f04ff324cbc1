"""What every fit of a whole record asks of its samples: numbers, the busiest stretch, outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import GATE, OUTLIER_SHARE
from backlash_ros.core.estimation.regression.residuals import bulk_std

Array = NDArray[np.float64]

SEARCHED_AT_MOST = 6000  # samples of a record that the search for the gap looks at


def check_record(v: Array, y: Array) -> None:
    """Raise ValueError unless v (N,) is finite, and y (N,) finite or nan where it was lost."""
    if v.ndim != 1 or v.shape != y.shape:
        raise ValueError(f'v {v.shape} and y {y.shape} must be of one length')
    if not np.isfinite(v).all():
        raise ValueError('v must be finite in every sample')
    if np.isinf(y).any():
        raise ValueError('y must be finite, or nan where it was lost')


def busiest(v: Array, y: Array) -> slice:
    """The stretch for the search in which v (N,) moves most while y (N,) is known."""
    if len(v) <= SEARCHED_AT_MOST:
        return slice(0, len(v))
    path = np.append(0.0, np.cumsum(np.abs(np.diff(v)) * np.isfinite(y[1:])))
    first = int(np.argmax(path[SEARCHED_AT_MOST - 1:] - path[:len(v) - SEARCHED_AT_MOST + 1]))
    return slice(first, first + SEARCHED_AT_MOST)


def outliers(residual: Array, least_std: float) -> NDArray[np.bool_]:
    """Readings that are none, by the bulk of a residual (N,), nan where y is not known.

    least_std: deviation of y that is believed at least. None at all where they are many.
    """
    size = np.abs(residual)
    known = size[np.isfinite(size)]
    typical = bulk_std(known) if len(known) else 0.0
    wild = size > GATE * max(typical, least_std)
    return wild if np.count_nonzero(wild) <= OUTLIER_SHARE * len(known) else np.zeros_like(wild)
