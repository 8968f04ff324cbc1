"""What a reading of y says of the output: one likelihood for noise, rounding and loss.

A reading y of a sensor without a step is normal around the output. One with a step delta says that
the output, blurred by noise of deviation sigma, lies within half a step of it:

    P(y | output) = [Phi((r + delta/2) / sigma) - Phi((r - delta/2) / sigma)] / delta
    r = y - output

Readings that repeat while the output stands still repeat one rounding: they are one reading.

Reference: L. Y. Wang, G. G. Yin, J.-F. Zhang, Y. Zhao, System Identification with Quantized
Observations, Birkhaeuser 2010.
"""

from __future__ import annotations

from functools import lru_cache
from math import log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Likelihood(NamedTuple):
    """Of each reading (N,): log of its density, its derivative by the output, and information."""

    log_density: Array
    score: Array
    information: Array


def step_of(y: Array) -> float:
    """The step of which all distances between readings (N,) are multiples; 0 for none."""
    even = 1e-3  # share of a step by which distances of readings may be off a whole number of them
    different = np.unique(y[np.isfinite(y)])
    if len(different) < 8:  # different ones that tell a step
        return 0.0
    apart = np.diff(different)
    apart = apart[apart > even * np.median(apart)]  # one reading may be rounded in two ways
    steps = apart / apart.min()
    return float(apart.min()) if abs(steps - np.round(steps)).max() < even else 0.0


def likelihood(r: Array, noise_std: float, step: float) -> Likelihood:
    """What readings say of outputs that they are off from by r (N,); step 0: none."""
    if not step:
        return Likelihood(
            -0.5 * (r / noise_std) ** 2 - log(sqrt(2.0 * pi) * noise_std), r / noise_std**2,
            np.full(len(r), noise_std**-2),
        )
    from scipy.special import log_ndtr  # where fits are made: 31 MB

    upper, lower = (r + 0.5 * step) / noise_std, (r - 0.5 * step) / noise_std
    # Of both tails the smaller one: the difference of two numbers near 1 would be rounding.
    mirrored = lower > 0.0
    more = log_ndtr(np.where(mirrored, -lower, upper))
    less = log_ndtr(np.where(mirrored, -upper, lower))
    log_probability = more + np.log(-np.expm1(np.minimum(less - more, -1e-300)))
    at_upper, at_lower = (
        np.exp(-0.5 * edge**2 - log_probability) / sqrt(2.0 * pi) for edge in (upper, lower)
    )
    score = (at_lower - at_upper) / noise_std
    curvature = (at_lower - at_upper) ** 2 + upper * at_upper - lower * at_lower
    # Readings deep within their interval say nothing, and would leave unknowns open.
    least = mean_information(round(step / noise_std, 6)) / step**2
    # As a density, to be compared with that of readings without a step.
    log_density = log_probability - log(step)
    return Likelihood(log_density, score, np.clip(curvature / noise_std**2, least, noise_std**-2))


@lru_cache(maxsize=256)
def mean_information(ratio: float) -> float:
    """Fisher's information of a reading about the output in steps, averaged over the step.

    ratio: step over the deviation of the noise.
    """
    reach, places = 6, 200  # of the average information: steps to both sides, and places within one
    from scipy.special import ndtr  # as above

    edges = np.arange(-reach, reach + 2) - 0.5
    arguments = (edges - ((np.arange(places) + 0.5) / places - 0.5)[:, None]) * ratio
    likelihood = np.diff(ndtr(arguments))
    slope = np.diff(np.exp(-0.5 * arguments**2)) * ratio / sqrt(2.0 * pi)
    each = np.divide(slope**2, likelihood, out=np.zeros_like(slope), where=likelihood > 0.0)
    return float(each.sum(axis=1).mean())


def independence(
    y: Array, known: Flags, output: Array, step: float,
) -> tuple[Array, NDArray[np.intp]]:
    """Share (N,) of an independent reading that each reading is; 0 where there is none.

    Equal readings, one after the other, count as one while the output (N,), as the fit has it,
    stays within a small part of the step. Also where each of these begins among those that are
    known.
    """
    same_place = 16  # parts of a step within which an output counts as standing still
    weights = known.astype(np.float64)
    where = np.flatnonzero(known)
    if not step or not len(where):
        return weights, np.arange(len(where))
    seen, place = y[where], np.floor(output[where] * (same_place / step))
    changes = (np.diff(seen) != 0.0) | (np.diff(place) != 0.0)
    begins = np.flatnonzero(np.append(True, changes))
    lengths = np.diff(np.append(begins, len(where)))
    weights[where] = np.repeat(1.0 / lengths, lengths)
    return weights, begins
