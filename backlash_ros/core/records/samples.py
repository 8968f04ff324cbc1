"""What every fit of a whole record asks of its samples: numbers, the busiest stretch, outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.settings import GATE, OUTLIER_SHARE

Array = NDArray[np.float64]

SEARCHED_AT_MOST = 6000  # samples of a record that a search for the gap looks at
TO_STD = 1.4826  # median absolute deviation of a normal distribution to its standard deviation


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
    typical = TO_STD * float(np.median(known)) if len(known) else 0.0
    wild = size > GATE * max(typical, least_std)
    return wild if np.count_nonzero(wild) <= OUTLIER_SHARE * len(known) else np.zeros_like(wild)


def frequencies_of(y: Array) -> tuple[float, float]:
    """Lowest and highest frequency between which y (N,) moves [rad/sample]; nan where lost."""
    motion = (0.1, 0.9)  # shares of the power of the moves of y below which its frequencies lie
    known = np.flatnonzero(np.isfinite(y))
    filled = np.interp(np.arange(len(y)), known, y[known])
    moves = np.diff(filled)
    power = np.abs(np.fft.rfft((moves - moves.mean()) * np.hanning(len(moves)))) ** 2
    total = np.cumsum(power)
    low, high = np.searchsorted(total, np.array(motion) * total[-1]) * (2.0 * np.pi / len(moves))
    return float(low), float(high)
