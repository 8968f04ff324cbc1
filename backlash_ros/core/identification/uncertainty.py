"""Standard deviations of a fit, with the autocorrelation of its residual.

C = (J'J)^-1 J' R J (J'J)^-1 with the Toeplitz matrix R of the residual's autocovariance, tapered to
zero at sqrt(N) lags. Of a white residual that is sigma^2 (J'J)^-1; the error of a quantised y is
not white. No variance is less than that of white noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import gammaincc

from backlash_ros.core.identification.output_error import (
    Fit,
    Samples,
    linear_rows,
    slope_rows,
)

Array = NDArray[np.float64]


class Covariance(NamedTuple):
    """Of the unknowns (a, gap, start, B, e, X), shape (K, K), in that order."""

    matrix: Array
    poles: int
    taps: int

    @property
    def gap(self) -> int:
        """Index of the gap; the start follows it, then B and e."""
        return self.poles

    @property
    def numerator(self) -> slice:
        """Indices of B."""
        return slice(self.poles + 2, self.poles + 2 + self.taps)

    @property
    def offset(self) -> int:
        """Index of e."""
        return self.poles + 2 + self.taps

    @property
    def coefficients(self) -> list[int]:
        """Indices of a and B."""
        return [*range(self.poles), *range(*self.numerator.indices(len(self.matrix)))]


def autocorrelation(residual: Array, lags: int) -> Array:
    """Of a residual with nan where it is not known, lags 0 to `lags`; 1 first."""
    known = np.isfinite(residual)
    filled = np.where(known, residual, 0.0)
    size = len(residual)
    products = _convolved(filled, filled[::-1])[size - 1:size + lags]
    counted = known.astype(float)
    pairs = np.round(_convolved(counted, counted[::-1])[size - 1:size + lags])
    covariance = products / np.maximum(pairs, 1.0)
    return np.asarray(covariance / covariance[0]) if covariance[0] > 0.0 else np.eye(lags + 1)[0]


def _convolved(a: Array, b: Array) -> Array:
    """The whole convolution along the first axis; scipy.signal costs a start of 0.3 s."""
    count = len(a) + len(b) - 1
    size = next_fast_len(count, real=True)
    product = rfft(a, size, axis=0) * rfft(b, size, axis=0)
    return np.asarray(irfft(product, size, axis=0))[:count]


def ljung_box(residual: Array) -> float:
    """Probability that a white residual looks as correlated as this one."""
    count = int(np.isfinite(residual).sum())
    lags = min(20, count // 5)
    r = autocorrelation(residual, lags)[1:]
    q = count * (count + 2.0) * float(np.sum(r**2 / (count - np.arange(1, lags + 1))))
    return float(gammaincc(0.5 * lags, 0.5 * q))  # the chi-squared distribution's upper tail


def covariance_of(samples: Samples, found: Fit) -> Covariance:
    """Covariance of everything that was fitted."""
    columns = np.vstack([
        slope_rows(samples, found), linear_rows(samples, found.structure, found.point.a, found.p),
    ]).T
    residual = samples.y - found.simulated
    columns[~np.isfinite(residual)] = 0.0
    size = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    size[size == 0.0] = np.inf  # what no sample depends on: not known, see below
    q, upper = np.linalg.qr(columns / size)
    u, s, vt = np.linalg.svd(upper)
    keep = s > 1e-10 * s[0]
    inverse = (vt.T[:, keep] / s[keep]) @ u.T[keep]
    rows = int(np.isfinite(residual).sum())
    freedom = max(rows - columns.shape[1], 1)
    variance = float(np.nansum(residual**2)) / freedom
    lags = max(round(np.sqrt(rows)), 1)
    r = autocorrelation(residual, lags) * (1.0 - np.arange(lags + 1) / (lags + 1.0))
    kernel = np.append(r[:0:-1], r)
    spread = _convolved(q, kernel[:, None])[lags:lags + len(q)]
    middle = q.T @ spread
    white = variance * inverse @ inverse.T
    matrix = variance * inverse @ (0.5 * (middle + middle.T)) @ inverse.T
    least = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(matrix), 1e-300), 1.0))
    matrix = matrix * np.outer(least, least)
    matrix = matrix / np.outer(size, size)
    return Covariance(matrix, found.structure.free_poles, found.structure.numerator_taps)


def crossings_covariance(found: Fit, covariance: Covariance) -> Array:
    """Covariance of (gap, c_r), shape (2, 2)."""
    total, offset = float(found.numerator.sum()), found.offset
    jacobian = np.zeros((2, len(covariance.matrix)))
    jacobian[0, covariance.gap] = 1.0
    jacobian[1, covariance.numerator] = offset / total**2
    jacobian[1, covariance.offset] = -1.0 / total
    if not found.structure.integrator:  # A(1) times the middle of y is part of the offset
        jacobian[1, :covariance.poles] = -found.middle / total
    return np.asarray(jacobian @ covariance.matrix @ jacobian.T)


def response(found: Fit, frequencies: Array) -> NDArray[np.complex128]:
    """m G at frequencies [rad/sample], without the delay."""
    back = np.exp(-1j * np.asarray(frequencies))
    top = back * np.polynomial.polynomial.polyval(back, found.numerator)
    return np.asarray(top / np.polynomial.polynomial.polyval(back, found.denominator))


def response_std(found: Fit, covariance: Covariance, frequencies: Array) -> Array:
    """Relative deviation of m G at frequencies [rad/sample], shape (N,)."""
    back = np.exp(-1j * np.asarray(frequencies, dtype=float))
    numerator, structure = found.numerator, found.structure
    free = np.polynomial.polynomial.polyval(back, np.append(1.0, found.point.a))
    top = np.polynomial.polynomial.polyval(back, numerator)
    # d log(mG): -z^-j / A' for a_j, z^-i / B for b_i.
    by_a = [-back**(j + 1) / free for j in range(structure.free_poles)]
    by_b = [back**i / top for i in range(structure.numerator_taps)]
    jacobian = np.array([*by_a, *by_b]).T
    part = covariance.matrix[np.ix_(covariance.coefficients, covariance.coefficients)]
    variance = np.einsum('ni,ij,nj->n', jacobian, part, jacobian.conj()).real
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def root_covariances(
    coefficients: Array, covariance: Array,
) -> tuple[NDArray[np.complex128], Array]:
    """Roots of c[0] z^n + ... (n,), and the covariance of (real, imaginary) of each, (n, 2, 2).

    covariance: of the coefficients.
    """
    roots = np.asarray(np.roots(coefficients), dtype=complex)
    derivative = np.polyder(coefficients)
    out = np.zeros((len(roots), 2, 2))
    degree = len(coefficients) - 1
    for k, root in enumerate(roots):
        slope = np.polyval(derivative, root)
        if slope == 0.0:
            out[k] = np.inf
            continue
        by = -root ** np.arange(degree, -1, -1) / slope
        both = np.vstack([by.real, by.imag])
        out[k] = both @ covariance @ both.T
    return roots, out
