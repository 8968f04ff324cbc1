"""Covariance of a fit whose residuals are correlated from sample to sample.

    C = H^-1 (J' R J) H^-1,   H = J'J + what is known beside the samples

with normalised rows J and the Toeplitz matrix R of the residual's autocovariance, tapered to zero
beyond those lags over which it lasts. Of white residuals that is H^-1; the error of a quantised y
is not white. No variance is less than that of white noise. Other than the inflation of a WindowFit
it believes that what is left over is noise, and averages out in the end.

High frequencies that v hardly had leave zeros and delay of G open. Whatever noise puts there, a
fast controller would act on it. Among the delays that fit alike, and within two standard deviations
of each fit, the model is taken whose |G|^2, summed over the frequencies at which G is not known, is
least: sampled plants that are driven through a hold have little gain there. Where the deviations of
the fit leave no such frequency, it is those at which the delays that fit alike contradict it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.identification.structure import VAGUE, Model

Array = NDArray[np.float64]

GRID: Array = np.pi * (np.arange(40) + 0.5) / 40  # frequencies [rad/sample]
SILENT = 0.1  # relative deviation, or difference, of G beyond which the record is silent


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


class Response(NamedTuple):
    """m G without its delay. covariance: of B and of A's coefficients that were fitted, a.

    denominator: 1, a; integrator: whether 1 - 1/z multiplies it.
    """

    numerator: Array
    denominator: Array
    integrator: bool
    covariance: Array

    def at(self, frequencies: Array) -> NDArray[np.complex128]:
        """At frequencies [rad/sample]."""
        back = np.exp(-1j * np.asarray(frequencies))
        value = back * polyval(back, self.numerator) / polyval(back, self.denominator)
        return np.asarray(value / (1.0 - back) if self.integrator else value)

    def std(self, frequencies: Array) -> Array:
        """Relative deviation at frequencies [rad/sample], shape (N,)."""
        back = np.exp(-1j * np.asarray(frequencies, dtype=float))
        free, top = polyval(back, self.denominator), polyval(back, self.numerator)
        # d log(mG): z^-i / B for b_i, -z^-j / A for a_j.
        jacobian = np.array([
            *(back**i / top for i in range(len(self.numerator))),
            *(-back**j / free for j in range(1, len(self.denominator))),
        ]).T
        variance = np.einsum('ni,ij,nj->n', jacobian, self.covariance, jacobian.conj()).real
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @property
    def known_up_to(self) -> float:
        """Frequency [rad/sample] from which on G is not known; pi where it is throughout."""
        known = np.flatnonzero(self.std(GRID) <= SILENT)
        return float(GRID[known[-1]]) if len(known) else float(GRID[0])


def response_of(found: Model, covariance: Array, unit: float = 1.0) -> Response:
    """Of a model with the covariance of its theta. unit: of y over that of v."""
    scale = np.append(np.full(found.structure.numerator_taps, unit * VAGUE),
                      np.full(found.structure.free_poles, VAGUE))
    return Response(unit * found.numerator, np.append(1.0, found.a), found.structure.integrator,
                    covariance[3:, 3:] * np.outer(scale, scale))


def least_response(best: Model, rivals: Sequence[Model] = ()) -> Model:
    """The model to take. rivals: with other delays, that fit alike."""
    if best.structure.numerator_taps < 2:
        return best  # a gain is the same at every frequency
    own = response_of(best, covariance_of(best.problem, best.fit))
    silent = own.known_up_to < GRID
    if not silent.any():
        for one in rivals:
            later = np.exp(-1j * GRID * (one.structure.delay - best.structure.delay))
            other = response_of(one, np.zeros_like(one.fit.cov))
            silent |= np.abs(other.at(GRID) * later / own.at(GRID) - 1.0) > SILENT
    if not silent.any():
        return best
    return min((_smoothed(one, GRID[silent], best.squares / effective(best.left))
                for one in (best, *rivals)),
               key=lambda one: float(np.sum((_rows(one, GRID[silent]) @ one.numerator) ** 2)))


def _rows(found: Model, silent: Array) -> Array:
    """Rows whose product with B is G at these frequencies, real and imaginary parts."""
    back = np.exp(-1j * silent)
    rows = back[:, None] ** np.arange(found.structure.numerator_taps) \
        / np.abs(polyval(back, found.denominator))[:, None]
    return np.vstack([rows.real, rows.imag])


def _smoothed(found: Model, silent: Array, noise_variance: float) -> Model:
    """The least of these gains within two deviations: the heaviest weight on them that stays there.
    """
    covariance = covariance_of(found.problem, found.fit)
    rows = np.zeros((2 * len(silent), len(covariance)))
    rows[:, 3:3 + found.structure.numerator_taps] = VAGUE * _rows(found, silent)
    pull = covariance @ rows.T @ rows
    for weight in 1e6 / max(float(np.trace(pull)), 1e-300) * 0.0625 ** np.arange(12.0):
        theta = np.linalg.solve(np.eye(len(pull)) + weight * pull, found.fit.theta)
        fit = replace(found.fit, theta=theta)
        if not np.isfinite(found.structure.at(fit.xi)[1]).all():
            continue  # a pole has left the unit circle
        smooth = Model(found.structure, found.problem, found.problem.begun(fit))
        if smooth.squares <= found.squares + 4.0 * noise_variance:
            return smooth
    return found
