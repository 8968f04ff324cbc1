"""Of models that a record cannot tell apart: the one with the least gain where it is silent.

High frequencies that v hardly had leave zeros and delay open. Whatever noise puts there, a fast
controller would act on it. Among the delays that fit alike, and within two standard deviations of
each fit, the model is taken whose |G|^2, summed over the frequencies at which G is not known, is
least: sampled plants that are driven through a hold have little gain there. Where the deviations of
the fit leave no such frequency, it is those at which the delays that fit alike contradict it.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.output_error import Fit, Samples, fit
from backlash_ros.core.identification.uncertainty import (
    Covariance,
    covariance_of,
    response,
    response_std,
)

Array = NDArray[np.float64]

POINTS = 40  # frequencies up to half the sampling rate
GRID: Array = np.pi * (np.arange(POINTS) + 0.5) / POINTS  # [rad/sample]
UNKNOWN = 0.1  # relative deviation, or difference, of G beyond which the record is silent


def least_response(
    samples: Samples, best: Fit, rivals: Sequence[Fit], noise_variance: float,
) -> Generator[None, None, tuple[Fit, Array | None]]:
    """The fit to take, and the penalty that it was made with, as `fit` takes it.

    rivals: with other delays, that fit alike. noise_variance: effective.
    """
    silent = _silent(samples, best)
    if not len(silent):
        silent = _contradicted(best, rivals)
    if not len(silent):
        return best, None
    found: list[tuple[float, Fit, Array | None]] = []
    for one in (best, *rivals):
        smooth, penalty = _smoothed(samples, one, silent, noise_variance)
        found.append((_gain(smooth, silent), smooth, penalty))
        yield
    return min(found, key=lambda one: one[0])[1:]


def _silent(samples: Samples, best: Fit) -> Array:
    """Frequencies [rad/sample] from which on G is not known."""
    return GRID[known_up_to(best, covariance_of(samples, best)) < GRID]


def _contradicted(best: Fit, rivals: Sequence[Fit]) -> Array:
    """Frequencies [rad/sample] at which another delay makes another G."""
    differs = np.zeros(POINTS, dtype=bool)
    for one in rivals:
        later = np.exp(-1j * GRID * (one.structure.delay - best.structure.delay))
        differs |= np.abs(response(one, GRID) * later / response(best, GRID) - 1.0) > UNKNOWN
    return np.asarray(GRID[differs])


def known_up_to(found: Fit, covariance: Covariance) -> float:
    """Frequency [rad/sample] from which on G is not known; pi where it is known throughout."""
    known = np.flatnonzero(response_std(found, covariance, GRID) <= UNKNOWN)
    return float(GRID[known[-1]]) if len(known) else float(GRID[0])


def _rows(found: Fit, silent: Array) -> Array:
    """Rows whose product with B is G at these frequencies, real and imaginary parts."""
    back = np.exp(-1j * silent)
    size = np.abs(np.polynomial.polynomial.polyval(back, found.denominator))
    rows = back[:, None] ** np.arange(found.structure.numerator_taps) / size[:, None]
    return np.vstack([rows.real, rows.imag])


def _gain(found: Fit, silent: Array) -> float:
    values = _rows(found, silent) @ found.numerator
    return float(values @ values)


def _smoothed(
    samples: Samples, found: Fit, silent: Array, noise_variance: float,
) -> tuple[Fit, Array | None]:
    """The fit with the heaviest penalty whose squares stay within what is allowed."""
    rows, gain = _rows(found, silent), _gain(found, silent)
    if gain == 0.0:
        return found, None
    most = found.squares + 4.0 * noise_variance  # two standard deviations
    factor = np.sqrt(1e4 * found.squares / gain)
    for _ in range(12):
        smooth = fit(samples, found.structure, found.point, penalty=factor * rows)
        if smooth.squares <= most:
            return smooth, factor * rows
        factor *= 0.25
    return found, None
