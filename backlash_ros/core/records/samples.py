"""What a record tells before any fit: whether it is one, its noise, its motion, its outliers.

A smooth motion is predicted from its neighbours; what is left over is noise, and instants that are
not the true ones make it rough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.settings import GATE, OUTLIER_SHARE

Array = NDArray[np.float64]

SEARCHED_AT_MOST = 6000  # samples of a record that a search for the gap looks at
FEWEST_VALUES = 20  # of a signal that tell how rough it is
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
    """Flags (N,) of what is beyond the bulk of a residual (N,), nan where y is lost; none where
    they are many. least_std: deviation of y that is believed at least."""
    size = np.abs(residual)
    known = size[np.isfinite(size)]
    typical = TO_STD * float(np.median(known)) if len(known) else 0.0
    wild = size > GATE * max(typical, least_std)
    return wild if np.count_nonzero(wild) <= OUTLIER_SHARE * len(known) else np.zeros_like(wild)


def frequencies_of(y: Array) -> tuple[float, float]:
    """Lowest and highest frequency between which y (N,) moves [rad/sample]; nan where lost."""
    motion = (0.1, 0.9)  # shares of the power of the moves of y below which its frequencies lie
    known = np.flatnonzero(np.isfinite(y))
    moves = np.diff(np.interp(np.arange(len(y)), known, y[known]))
    power = np.abs(np.fft.rfft((moves - moves.mean()) * np.hanning(len(moves)))) ** 2
    total = np.cumsum(power)
    low, high = np.searchsorted(total, np.array(motion) * total[-1]) * (2.0 * np.pi / len(moves))
    return float(low), float(high)


def _residuals(t: Array, s: Array, reach: int) -> Array:
    """Error of predicting each value from `reach` neighbours on each side, per unit of noise."""
    if len(s) < FEWEST_VALUES:
        return np.empty(0)
    t = t - t[0]
    sides = [j for j in range(-reach, reach + 1) if j]
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
    """Log of how much rougher a signal (N,) is over the instants t (N,) than over other (N,)."""
    known, sizes = np.isfinite(signal), []
    for instants in (t, other):
        squares = _residuals(instants[known], signal[known], 1)**2
        if len(squares) < FEWEST_VALUES:
            return 0.0
        # Steps are as rough over any instants.
        sizes.append(float(np.mean(np.minimum(squares, np.percentile(squares, 98.0)))))
    return 0.5 * float(np.log(sizes[0] / sizes[1])) if min(sizes) > 0.0 else 0.0
