"""How far a fit may be off: by residuals that are correlated, and by other models that fit alike.

Of residuals that are correlated from sample to sample, the covariance of a fit is

    C = H^-1 (J' R J) H^-1,   H = J'J + what is known beside the samples

with normalised rows J and the Toeplitz matrix R of the residual's autocovariance, tapered to zero
beyond those lags over which it lasts. No variance is less than that of white noise.
"""

from collections.abc import Iterable
from math import sqrt

import numpy as np

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.transfer_function import Array


def autocorrelation(residual: Array, lags: int) -> Array:
    """Of a residual with nan where it is not known, lags 0 to `lags`; 1 first."""
    known = np.isfinite(residual)
    spectra = np.fft.rfft([np.where(known, residual, 0.0), known], 2 * len(residual))
    products, pairs = np.fft.irfft(np.abs(spectra)**2)[:, :lags + 1]
    covariance = products / np.maximum(np.round(pairs), 1.0)
    return np.asarray(covariance / covariance[0]) if covariance[0] > 0.0 else np.eye(lags + 1)[0]


def covariance_of(problem: Problem, f: WindowFit) -> Array:
    """Covariance of theta, shape (3 + K, 3 + K)."""
    columns, count = problem.rows(f)[:, :-1], len(problem.v)
    run = problem.at(f)
    _, score, information = run.likelihood
    residual = np.where(problem.known, score * np.sqrt(run.weights / information), np.nan)
    columns[:count][~problem.known] = 0.0
    size = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    size[size == 0.0] = np.inf  # what no sample depends on
    q, upper = np.linalg.qr(columns / size)
    rows = int(problem.known.sum())
    variance = float(np.nansum(residual**2)) / max(rows - columns.shape[1], 1)
    # As many as the correlation lasts (D. W. K. Andrews, Econometrica 59 (1991) 817-858).
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
    """Deviation of a gap by other models (gap, twice the log-likelihood by which it falls behind):
    as of a profile likelihood, by the steepest one."""
    return max((abs(other - gap) / sqrt(max(behind, 1.0))
                for other, behind in others if behind <= 4.0), default=0.0)


def effective(residual: Array) -> float:
    """How many independent ones residuals (R,) count as; nan counts as none."""
    r = lag_one(residual)
    return np.count_nonzero(np.isfinite(residual)) * (1.0 - r) / (1.0 + r)


def lag_one(residual: Array, certain: bool = False) -> float:
    """Correlation of successive residuals (R,) but for nan, at least 0; certain: beyond chance."""
    residual = residual[np.isfinite(residual)]
    energy = float(residual @ residual)
    if energy == 0.0 or not np.isfinite(energy):
        return 0.0
    chance = 3.0 / sqrt(len(residual)) if certain else 0.0
    return min(max(float(residual[1:] @ residual[:-1]) / energy - chance, 0.0), 0.99)
