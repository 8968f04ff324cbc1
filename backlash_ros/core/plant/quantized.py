"""Readings of y that are quantized: their step, their likelihood, and how many are independent.

A reading is normally distributed around the output. If it is quantized with step delta, it says
that output plus noise (standard deviation sigma) lies within half a step of it (L. Y. Wang et al.,
System Identification with Quantized Observations, Birkhaeuser 2010):

    P(y | output) = [Phi((r + delta/2) / sigma) - Phi((r - delta/2) / sigma)] / delta
    r = y - output
"""

from math import exp, inf, log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.transfer_function import Array


def step_of(y: Array) -> float:
    """The quantization step, of which all differences of readings (N,) are multiples; 0 if none.

    It needs no repeated readings, but all their digits.
    """
    even = 1e-3  # tolerance of that, in steps
    different = np.unique(y[np.isfinite(y)])
    if len(different) < 8:  # distinct readings needed to tell a step
        return 0.0
    apart = np.diff(different)
    apart = apart[apart > even * np.median(apart)]  # not floating-point errors
    step = float(apart.min())
    for _ in range(4):  # Euclid's algorithm, as none may be a single step apart in a fast motion
        left = np.abs(apart - step * np.round(apart / step))
        left = left[left > even * step]
        if not left.size:
            return step
        step = float(left.min())
    return 0.0


class Likelihood(NamedTuple):
    """For each reading (N,): log-density, score (derivative of that by the output), information."""

    log_density: Array
    score: Array
    information: Array


def likelihood(r: Array, noise_std: float, step: float, weights: Array) -> Likelihood:
    """Likelihood of readings with residuals r and weights, both (N,); step 0: not quantized."""
    if not step:
        density = -0.5 * (r / noise_std) ** 2 - log(sqrt(2.0 * pi) * noise_std)
        return Likelihood(density, r / noise_std**2, np.full(len(r), noise_std**-2))
    probability, score, curvature = log_probability(r / noise_std, 0.5 * step / noise_std)
    # Each gets at least the mean information, or unknowns could stay undetermined; the sum is kept.
    total = weights @ curvature + 1e-9  # positive even if no reading says anything
    information = np.maximum(curvature, total / (weights.sum() + 1e-9))
    information *= total / (weights @ information + 1e-9)
    return Likelihood(probability - log(step), score / noise_std, information / noise_std**2)


def independence(
    y: Array, known: NDArray[np.bool_], output: Array, step: float, noise_std: float = inf,
) -> tuple[Array, NDArray[np.intp]]:
    """Weights (N,) that count repeated readings once, and the group of each known reading (K,).

    noise_std: of readings that are taken as values, rounding included; inf for intervals.
    """
    same_place = 16  # parts of a step; outputs within one part are at the same place
    weights = known.astype(np.float64)
    if not step or not known.any():
        return weights, np.arange(int(weights.sum()))
    read, places = y[known], np.floor(output[known] * (same_place / step))
    row = np.cumsum(np.append(0, (np.diff(read) != 0.0) | (np.diff(places) != 0.0)))
    moves = np.diff(places, prepend=places[:1], append=places[-1:])
    # If the output passes a place in the same way again with the same reading, quantization errors
    # repeat. A way: a place, the moves to and from it. Irrational weights make its sum unique.
    _, first, way = np.unique(places + sqrt(2.0) * moves[:-1] + sqrt(3.0) * moves[1:],
                              return_index=True, return_inverse=True)
    differ = (np.bincount(way, np.abs(read - read[first[way]])) > 0.5 * step)[way]
    number = np.where(differ, row, row[first[way]])
    # Where noise makes readings differ, all of one stay at a place count alike, together as many as
    # there are rows of equal ones: if each row counted once, rare readings would count for more.
    stay = np.cumsum(np.append(0, np.diff(places) != 0.0))
    length = np.bincount(stay)
    alike = np.bincount(stay, np.diff(row, prepend=-1)) / length
    weights[known] = np.where(differ, alike[stay], 1.0 / np.bincount(number)[number])
    # The mean of any number of values keeps the error that rounding has left beside the noise, a
    # share of the square of each: B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008.
    noise = max((noise_std / step) ** 2, 1.0 / 12.0)
    left = exp(-4.0 * pi**2 * (noise - 1.0 / 12.0)) / (2.0 * pi**2 * noise)
    weights[known] = np.minimum(weights[known], 1.0 / (1.0 + left * length[stay]))
    return weights, number


def log_probability(r: Array, half: float) -> tuple[Array, Array, Array]:
    """Log-probability that a standard normal variable lies within `half` of r (N,), its derivative
    by -r, and the negative of its second derivative."""
    from scipy.special import log_ndtr  # where it is needed: 31 MB

    upper, lower = r + half, r - half
    # From the smaller tail: a difference of two numbers near 1 would be lost to rounding.
    more, less = log_ndtr(half - np.abs(r)), log_ndtr(-half - np.abs(r))
    probability = more + np.log(-np.expm1(np.minimum(less - more, -1e-300)))
    at_upper, at_lower = (
        np.exp(-0.5 * edge**2 - probability) / sqrt(2.0 * np.pi) for edge in (upper, lower))
    score = at_lower - at_upper
    return probability, score, score**2 + upper * at_upper - lower * at_lower
