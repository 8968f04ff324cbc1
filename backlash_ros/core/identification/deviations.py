"""Covariance of a fit whose residuals are correlated from sample to sample.

    C = H^-1 (J' R J) H^-1,   H = J'J + what is known beside the samples

with normalised rows J and the Toeplitz matrix R of the residual's autocovariance, tapered to zero
beyond those lags over which it lasts. Of white residuals that is H^-1; the error of a quantised y
is not white. No variance is less than that of white noise. Other than the inflation of a WindowFit
it believes that what is left over is noise, and averages out in the end.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import WindowFit

Array = NDArray[np.float64]


def autocorrelation(residual: Array, lags: int) -> Array:
    """Of a residual with nan where it is not known, lags 0 to `lags`; 1 first."""
    known = np.isfinite(residual)
    filled, size = np.where(known, residual, 0.0), len(residual)
    products, pairs = (_convolved(x, x[::-1])[size - 1:size + lags]
                       for x in (filled, known.astype(float)))
    covariance = products / np.maximum(np.round(pairs), 1.0)
    return np.asarray(covariance / covariance[0]) if covariance[0] > 0.0 else np.eye(lags + 1)[0]


def _convolved(a: Array, b: Array) -> Array:
    """The whole convolution along the first axis; that of SciPy costs a start of 0.3 s."""
    count = len(a) + len(b) - 1
    size = 2 ** (count - 1).bit_length()
    product = np.fft.rfft(a, size, axis=0) * np.fft.rfft(b, size, axis=0)
    return np.asarray(np.fft.irfft(product, size, axis=0)[:count])


def covariance_of(problem: Problem, f: WindowFit) -> Array:
    """Covariance of theta, shape (3 + K, 3 + K)."""
    columns, count = problem.rows(f)[:, :-1], len(problem.v)
    residual = np.where(problem.known, problem.normalised(f), np.nan)
    columns[:count][~problem.known] = 0.0
    size = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    size[size == 0.0] = np.inf  # what no sample depends on
    q, upper = np.linalg.qr(columns / size)
    inverse = np.linalg.pinv(upper, rcond=1e-12)
    rows = int(problem.known.sum())
    variance = float(np.nansum(residual**2)) / max(rows - columns.shape[1], 1)
    # As many as the correlation lasts (D. W. K. Andrews, Econometrica 59 (1991) 817-858).
    r = lag_one(residual[problem.known])
    lasts = 1.1447 * (4.0 * r**2 / (1.0 - r**2) ** 2 * rows) ** (1.0 / 3.0)
    lags = max(round(max(sqrt(rows), min(lasts, 0.25 * rows))), 1)
    r = autocorrelation(residual, lags) * (1.0 - np.arange(lags + 1) / (lags + 1.0))
    q[~np.append(problem.known, np.zeros(len(q) - count, dtype=bool))] = 0.0
    middle = q[:count].T @ _convolved(
        q[:count], np.append(r[:0:-1], r)[:, None])[lags:lags + count]
    values, vectors = np.linalg.eigh(0.5 * (middle + middle.T))
    root = inverse @ vectors * np.sqrt(variance * np.maximum(values, 1.0)) / size[:, None]
    matrix = root @ root.T
    at = len(matrix) - len(f.theta)
    return np.asarray(matrix[at:, at:])


def by_model(gap: float, others: Iterable[tuple[float, float]]) -> float:
    """Deviation of a gap that other models tell: as of a profile likelihood, by the steepest one.

    others: gap of each, and twice the log-likelihood by which it falls behind.
    """
    return max((abs(other - gap) / sqrt(max(behind, 1.0))
                for other, behind in others if behind <= 4.0), default=0.0)


def effective(residual: Array) -> float:
    """How many independent ones residuals (R,) count as: N (1 - r) / (1 + r); nan counts as none.
    """
    r = lag_one(residual)
    return np.count_nonzero(np.isfinite(residual)) * (1.0 - r) / (1.0 + r)


def lag_one(residual: Array, certain: bool = False) -> float:
    """Correlation of the residuals (R,) of successive rows but for nan, at least 0.

    certain: only as far as it is beyond that of white noise.
    """
    residual = residual[np.isfinite(residual)]
    energy = float(residual @ residual)
    if energy == 0.0 or not np.isfinite(energy):
        return 0.0
    chance = 3.0 / sqrt(len(residual)) if certain else 0.0
    return min(max(float(residual[1:] @ residual[:-1]) / energy - chance, 0.0), 0.99)
