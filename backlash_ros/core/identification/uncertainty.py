"""Standard deviations of a fit, with the autocorrelation of its residual.

C = (J'J)^-1 J' R J (J'J)^-1 with the Toeplitz matrix R of the residual's autocovariance, tapered to
zero at sqrt(N) lags. Of a white residual that is sigma^2 (J'J)^-1; the error of a quantised y is
not white. No variance is less than that of white noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import gammaincc

from backlash_ros.core.identification.output_error import Fit, linear_rows, slope_rows

Array = NDArray[np.float64]


class Covariance(NamedTuple):
    """Of the unknowns (a, gap, start, B, e, X), shape (K, K), in that order."""

    matrix: Array
    poles: int
    taps: int

    @property
    def numerator(self) -> slice:
        """Indices of B."""
        return slice(self.poles + 2, self.poles + 2 + self.taps)

    @property
    def coefficients(self) -> list[int]:
        """Indices of a and B."""
        return [*range(self.poles), *range(*self.numerator.indices(len(self.matrix)))]


def autocorrelation(residual: Array, lags: int) -> Array:
    """Of a residual with nan where it is not known, lags 0 to `lags`; 1 first."""
    known = np.isfinite(residual)
    filled, size = np.where(known, residual, 0.0), len(residual)
    products, pairs = (_convolved(x, x[::-1])[size - 1:size + lags]
                       for x in (filled, known.astype(float)))
    covariance = products / np.maximum(np.round(pairs), 1.0)
    return np.asarray(covariance / covariance[0]) if covariance[0] > 0.0 else np.eye(lags + 1)[0]


def _convolved(a: Array, b: Array) -> Array:
    """The whole convolution along the first axis; scipy.signal costs a start of 0.3 s."""
    count = len(a) + len(b) - 1
    size = next_fast_len(count, real=True)
    return np.asarray(irfft(rfft(a, size, axis=0) * rfft(b, size, axis=0), size, axis=0))[:count]


def ljung_box(residual: Array) -> float:
    """Probability that a white residual looks as correlated as this one."""
    count = int(np.isfinite(residual).sum())
    lags = min(20, count // 5)
    r = autocorrelation(residual, lags)[1:]
    q = count * (count + 2.0) * float(np.sum(r**2 / (count - np.arange(1, lags + 1))))
    return float(gammaincc(0.5 * lags, 0.5 * q))  # the chi-squared distribution's upper tail


def covariance_of(found: Fit) -> Covariance:
    """Covariance of everything that was fitted."""
    columns = np.vstack([slope_rows(found), linear_rows(
        found.samples, found.structure, found.point.a, found.p)]).T
    residual = found.residual
    columns[~np.isfinite(residual)] = 0.0
    size = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    size[size == 0.0] = np.inf  # what no sample depends on: not known, see below
    q, upper = np.linalg.qr(columns / size)
    inverse = np.linalg.pinv(upper, rcond=1e-10)
    rows = int(np.isfinite(residual).sum())
    variance = float(np.nansum(residual**2)) / max(rows - columns.shape[1], 1)
    lags = max(round(np.sqrt(rows)), 1)
    r = autocorrelation(residual, lags) * (1.0 - np.arange(lags + 1) / (lags + 1.0))
    middle = q.T @ _convolved(q, np.append(r[:0:-1], r)[:, None])[lags:lags + len(q)]
    white = variance * inverse @ inverse.T
    matrix = variance * inverse @ (0.5 * (middle + middle.T)) @ inverse.T
    least = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(matrix), 1e-300), 1.0))
    matrix = matrix * np.outer(least, least) / np.outer(size, size)
    return Covariance(matrix, found.structure.free_poles, found.structure.numerator_taps)


def crossings_covariance(found: Fit, covariance: Covariance) -> Array:
    """Covariance of (gap, c_r), shape (2, 2)."""
    total = float(found.numerator.sum())
    jacobian = np.zeros((2, len(covariance.matrix)))
    jacobian[0, covariance.poles] = 1.0
    jacobian[1, covariance.numerator] = found.offset / total**2
    jacobian[1, covariance.numerator.stop] = -1.0 / total
    if not found.structure.integrator:  # A(1) times the middle of y is part of the offset
        jacobian[1, :covariance.poles] = -found.samples.middle / total
    return np.asarray(jacobian @ covariance.matrix @ jacobian.T)


def response(found: Fit, frequencies: Array) -> NDArray[np.complex128]:
    """m G at frequencies [rad/sample], without the delay."""
    back = np.exp(-1j * np.asarray(frequencies))
    return np.asarray(
        back * polyval(back, found.numerator) / polyval(back, found.denominator))


def response_std(found: Fit, covariance: Covariance, frequencies: Array) -> Array:
    """Relative deviation of m G at frequencies [rad/sample], shape (N,)."""
    back = np.exp(-1j * np.asarray(frequencies, dtype=float))
    free, top = polyval(back, np.append(1.0, found.point.a)), polyval(back, found.numerator)
    # d log(mG): -z^-j / A' for a_j, z^-i / B for b_i.
    jacobian = np.array([
        *(-back**(j + 1) / free for j in range(covariance.poles)),
        *(back**i / top for i in range(covariance.taps)),
    ]).T
    part = covariance.matrix[np.ix_(covariance.coefficients, covariance.coefficients)]
    variance = np.einsum('ni,ij,nj->n', jacobian, part, jacobian.conj()).real
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
