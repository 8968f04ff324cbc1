"""G as it was found, over frequency: how surely it is known, and its gentlest form where it is not.

High frequencies that v hardly had leave zeros and delay open. Whatever noise puts there, a fast
controller would act on it. Among the delays that fit alike, and within two standard deviations of
each fit, the model is taken whose |G|^2, summed over the frequencies at which G is not known, is
least: sampled plants that are driven through a hold have little gain there. Where the deviations of
the fit leave no such frequency, it is those at which the delays that fit alike contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import FIRST_STEPS
from backlash_ros.core.estimation.posterior import Prior
from backlash_ros.core.identification.deviations import covariance_of
from backlash_ros.core.identification.structure import VAGUE, Model, Samples, fitted

Array = NDArray[np.float64]

GRID: Array = np.pi * (np.arange(40) + 0.5) / 40  # frequencies [rad/sample]
SILENT = 0.1  # relative deviation, or difference, of G beyond which the record is silent


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


def least_response(
    samples: Samples, best: Model, rivals: Sequence[Model], noise_variance: float,
) -> tuple[Model, Prior | None]:
    """The model to take, and the rows that its fit needs beside the samples.

    rivals: with other delays, that fit alike. noise_variance: effective.
    """
    if best.structure.numerator_taps < 2:
        return best, None  # a gain is the same at every frequency
    own = response_of(best, covariance_of(best.problem, best.fit))
    silent = own.known_up_to < GRID
    if not silent.any():
        for one in rivals:
            later = np.exp(-1j * GRID * (one.structure.delay - best.structure.delay))
            other = response_of(one, np.zeros_like(one.fit.cov))
            silent |= np.abs(other.at(GRID) * later / own.at(GRID) - 1.0) > SILENT
    if not silent.any():
        return best, None
    smooth = [_smoothed(samples, one, GRID[silent], noise_variance) for one in (best, *rivals)]
    return min(smooth, key=lambda one: _gain(one[0], GRID[silent]))


def _gain(found: Model, silent: Array) -> float:
    """|G|^2 summed over frequencies."""
    return float(np.sum((_rows(found, silent) @ found.numerator) ** 2))


def _rows(found: Model, silent: Array) -> Array:
    """Rows whose product with B is G at these frequencies, real and imaginary parts."""
    back = np.exp(-1j * silent)
    rows = back[:, None] ** np.arange(found.structure.numerator_taps) \
        / np.abs(polyval(back, found.denominator))[:, None]
    return np.vstack([rows.real, rows.imag])


def _smoothed(
    samples: Samples, found: Model, silent: Array, noise_variance: float,
) -> tuple[Model, Prior | None]:
    """The fit with the heaviest weight on these gains that stays within two deviations."""
    weights = np.sqrt(1e4 * len(found.left) / max(_gain(found, silent), 1e-300)) \
        * 0.25 ** np.arange(12.0)
    best: tuple[Model, Prior | None] = found, None
    low, high = 0, len(weights)
    while low < high:  # the lighter, the closer to the fit without
        middle = (low + high) // 2
        rows = np.zeros((2 * len(silent), len(found.fit.theta)))
        rows[:, 3:3 + found.structure.numerator_taps] = \
            weights[middle] * VAGUE * _rows(found, silent)
        beside = Prior(rows, np.zeros(len(rows)))
        smooth = fitted(samples, found.structure, found.fit, FIRST_STEPS, beside)
        if smooth.squares <= found.squares + 4.0 * noise_variance:
            best, high = (smooth, beside), middle
        else:
            low = middle + 1
    return best
