"""Standard deviations of a fit, for correlated residuals and for other models that fit as well.

If residuals are correlated from sample to sample, the covariance of a fit is

    C = H^-1 (J' R J) H^-1,   H = J'J + prior information

with normalised rows J and the Toeplitz matrix R of the residual's autocovariance, tapered to zero
over the lags for which it lasts. No variance is less than that for white noise.
"""

from collections.abc import Iterable
from math import sqrt

import numpy as np

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.transfer_function import Array


def autocorrelation(residual: Array, lags: int) -> Array:
    """Autocorrelation at lags 0 to `lags` of a residual (N,), nan where it is unknown."""
    known = np.isfinite(residual)
    spectra = np.fft.rfft([np.where(known, residual, 0.0), known], 2 * len(residual))
    products, pairs = np.fft.irfft(np.abs(spectra)**2)[:, :lags + 1]
    covariance = products / np.maximum(np.round(pairs), 1.0)
    return np.asarray(covariance / covariance[0]) if covariance[0] > 0.0 else np.eye(lags + 1)[0]


def covariance_of(problem: Problem, f: WindowFit) -> Array:
    """Covariance of theta, shape (3 + K, 3 + K), that allows for correlated residuals."""
    columns, count = problem.rows(f)[:, :-1], len(problem.v)
    run = problem.at(f)
    _, score, information = run.likelihood
    residual = np.where(problem.known, score * np.sqrt(run.weights / information), np.nan)
    columns[:count][~problem.known] = 0.0
    size = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    size[size == 0.0] = np.inf  # of unknowns on which no sample depends
    q, upper = np.linalg.qr(columns / size)
    rows = int(problem.known.sum())
    variance = float(np.nansum(residual**2)) / max(rows - columns.shape[1], 1)
    # Lags over which the correlation lasts (D. W. K. Andrews, Econometrica 59 (1991) 817-858).
    r = lag_one(residual[problem.known])
    lasts = 1.1447 * (4.0 * r**2 / (1.0 - r**2) ** 2 * rows) ** (1.0 / 3.0)
    lags = max(round(max(sqrt(rows), min(lasts, 0.25 * rows))), 1)
    taper = autocorrelation(residual, lags) * (1.0 - np.arange(lags + 1) / (lags + 1.0))
    of_rows = np.fft.fft(q[:count] * problem.known[:, None], 2 * count, axis=0)
    spectrum = 2.0 * np.fft.fft(taper, 2 * count).real - taper[0]
    middle = (of_rows.conj().T @ (spectrum[:, None] * of_rows)).real / (2 * count)
    values, vectors = np.linalg.eigh(middle)
    root = np.linalg.pinv(upper, rcond=1e-12) @ vectors \
        * np.sqrt(variance * np.maximum(values, 1.0)) / size[:, None]
    matrix, at = root @ root.T, len(root) - len(f.theta)
    return np.asarray(matrix[at:, at:])


def by_model(gap: float, others: Iterable[tuple[float, float]]) -> float:
    """Standard deviation of a gap from other models, as (gap, twice their loss of log-likelihood):
    the largest that a parabolic profile likelihood through one of them has, 0 if none is near."""
    return max((abs(other - gap) / sqrt(max(behind, 1.0))
                for other, behind in others if behind <= 4.0), default=0.0)


def effective(residual: Array) -> float:
    """Number of independent residuals that the residuals (R,) are worth; nan is left out."""
    r = lag_one(residual)
    return np.count_nonzero(np.isfinite(residual)) * (1.0 - r) / (1.0 + r)


def lag_one(residual: Array, certain: bool = False) -> float:
    """Lag-1 correlation of residuals (R,) without nan, at least 0; certain: beyond 3/sqrt(R)."""
    residual = residual[np.isfinite(residual)]
    energy = float(residual @ residual)
    if energy == 0.0 or not np.isfinite(energy):
        return 0.0
    chance = 3.0 / sqrt(len(residual)) if certain else 0.0
    return min(max(float(residual[1:] @ residual[:-1]) / energy - chance, 0.0), 0.99)
