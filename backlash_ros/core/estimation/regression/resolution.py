"""Readings of a sensor with a resolution: each of them tells an interval, not a value.

A reading y says that the output lay within half a step delta of it, blurred by noise of deviation
sigma_e:

    P(y | output) = Phi((r + delta/2) / sigma_e) - Phi((r - delta/2) / sigma_e)          (6)
    r = y - output

Taken for noise, rounding tells less than it could, and where it repeats, as at a constant speed,
it looks like motion that nothing explains. The likelihood is concave in the output.

Reference: L. Y. Wang, G. G. Yin, J.-F. Zhang, Y. Zhao, System Identification with Quantized
Observations, Birkhaeuser 2010.
"""

from __future__ import annotations

from functools import lru_cache
from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

Array = NDArray[np.float64]

REACH, PLACES = 6, 200  # of the average: steps on both sides, and places within one
# --- guards
EVEN = 1e-3  # share of a step by which a distance of two readings may be off a whole number of them
FEWEST_READINGS = 30  # different ones that tell a resolution


class Rounding(NamedTuple):
    """Of readings: their step, the noise beside it, and the deviation that both count as."""

    resolution: float
    noise_std: float
    together: float

    @property
    def information(self) -> float:
        """Of a reading."""
        return information_of(self.resolution, self.noise_std)


class Cells(NamedTuple):
    """Of each reading: its log-likelihood, its derivative by the output, and its information.

    That is minus the second derivative, but no less than a reading tells on average: those deep
    within their interval say nothing, and would leave unknowns open. All of shape (N,).
    """

    likelihood: Array
    score: Array
    information: Array


def resolution_of(y: Array) -> float:
    """Step of which all distances between readings (N,) are multiples; 0 where there is none."""
    different = np.unique(y[np.isfinite(y)])
    if len(different) < FEWEST_READINGS:
        return 0.0
    apart = np.diff(different)
    # The same reading may have been rounded in two ways.
    apart = apart[apart > EVEN * np.median(apart)]
    step = float(apart.min())
    steps = apart / step
    return step if float(np.abs(steps - np.round(steps)).max()) <= EVEN else 0.0


def cells(residual: Array, resolution: float, noise_std: float) -> Cells:
    """What readings say of an output that they are off by `residual` (N,)."""
    upper = (residual + 0.5 * resolution) / noise_std
    lower = (residual - 0.5 * resolution) / noise_std
    # Of both tails the smaller one: the difference of two numbers near 1 would be rounding.
    mirrored = lower > 0.0
    log_more = log_ndtr(np.where(mirrored, -lower, upper))
    log_less = log_ndtr(np.where(mirrored, -upper, lower))
    likelihood = log_more + np.log(-np.expm1(log_less - log_more))
    at_upper, at_lower = (
        np.exp(-0.5 * edge**2 - likelihood) / sqrt(2.0 * pi) for edge in (upper, lower)
    )
    score = (at_lower - at_upper) / noise_std
    curvature = (score * noise_std) ** 2 + (upper * at_upper - lower * at_lower)
    # No more than that of a value that was read exactly: beyond it is cancellation.
    information = np.maximum(
        np.minimum(curvature, 1.0) / noise_std**2, information_of(resolution, noise_std)
    )
    return Cells(likelihood, score, information)


@lru_cache(maxsize=64)
def information_of(resolution: float, noise_std: float) -> float:
    """What one reading tells of the output on average: Fisher's information.

    Wherever the output is within the step, which is as likely as anywhere else.
    """
    edges = (np.arange(-REACH, REACH + 2) - 0.5) * resolution
    output = ((np.arange(PLACES) + 0.5) / PLACES - 0.5)[:, None] * resolution
    arguments = (edges - output) / noise_std
    likelihood = np.diff(ndtr(arguments))
    slope = np.diff(np.exp(-0.5 * arguments**2)) / (sqrt(2.0 * pi) * noise_std)
    told = np.divide(slope**2, likelihood, out=np.zeros_like(slope), where=likelihood > 0.0)
    return float(told.sum(axis=1).mean())
