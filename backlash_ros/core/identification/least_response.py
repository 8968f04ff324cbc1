"""Of models that a record cannot tell apart: the one with the least gain where it is silent.

High frequencies that v hardly had leave zeros and delay open. Whatever noise puts there, a fast
controller would act on it. Among the delays that fit alike, and within two standard deviations of
each fit, the model is taken whose |G|^2, summed over the frequencies at which G is not known, is
least: sampled plants that are driven through a hold have little gain there. Where the deviations of
the fit leave no such frequency, it is those at which the delays that fit alike contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.output_error import Fit, fit
from backlash_ros.core.identification.uncertainty import (
    Covariance,
    covariance_of,
    response,
    response_std,
)

Array = NDArray[np.float64]

GRID: Array = np.pi * (np.arange(40) + 0.5) / 40  # frequencies [rad/sample]
SILENT = 0.1  # relative deviation, or difference, of G beyond which the record is silent


def least_response(best: Fit, rivals: Sequence[Fit], noise_variance: float) -> Fit:
    """The fit to take, whose samples have the penalty that it was made with.

    rivals: with other delays, that fit alike. noise_variance: effective.
    """
    silent = known_up_to(best, covariance_of(best)) < GRID
    if not silent.any():
        for one in rivals:
            later = np.exp(-1j * GRID * (one.structure.delay - best.structure.delay))
            ratio = response(one, GRID) * later / response(best, GRID)
            silent |= np.abs(ratio - 1.0) > SILENT
    if not silent.any():
        return best
    smooth = [_smoothed(one, GRID[silent], noise_variance) for one in (best, *rivals)]
    return min(smooth, key=lambda one: float(np.sum(
        (_rows(one, GRID[silent]) @ one.numerator) ** 2)))


def known_up_to(found: Fit, covariance: Covariance) -> float:
    """Frequency [rad/sample] from which on G is not known; pi where it is known throughout."""
    known = np.flatnonzero(response_std(found, covariance, GRID) <= SILENT)
    return float(GRID[known[-1]]) if len(known) else float(GRID[0])


def _rows(found: Fit, silent: Array) -> Array:
    """Rows whose product with B is G at these frequencies, real and imaginary parts."""
    back = np.exp(-1j * silent)
    size = np.abs(np.polynomial.polynomial.polyval(back, found.denominator))
    rows = back[:, None] ** np.arange(found.structure.numerator_taps) / size[:, None]
    return np.vstack([rows.real, rows.imag])


def _smoothed(found: Fit, silent: Array, noise_variance: float) -> Fit:
    """The fit with the heaviest penalty whose squares stay within two standard deviations."""
    rows = _rows(found, silent)
    gain = float(np.sum((rows @ found.numerator) ** 2))
    if gain == 0.0:
        return found
    for factor in np.sqrt(1e4 * found.squares / gain) * 0.25 ** np.arange(12.0):
        smooth = fit(
            replace(found.samples, penalty=factor * rows), found.structure, found.point)
        if float(np.nansum(smooth.residual**2)) <= found.squares + 4.0 * noise_variance:
            return smooth
    return found
