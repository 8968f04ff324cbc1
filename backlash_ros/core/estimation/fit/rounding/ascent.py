"""Newton's way up a log-posterior of readings that were rounded, and the noise beside the rounding.

With less and less noise as long as that is likelier: with much of it the readings lead from
anywhere, with little of it they tell the most.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

QUIETER = 0.25  # ratio of one size of the noise that is tried to the one before
NEWTON_STEPS = 10  # at each size of the noise, at most
GAIN = 0.1  # log-likelihood that another step has to promise
SHORTER, SHORTEST = 0.4, 0.05  # share of a step that is tried next, and the least one


class Place(NamedTuple):
    """The log-posterior at a place, its gradient (p,), and minus its second derivatives (p, p)."""

    value: float
    gradient: Array
    precision: Array


class LogPosterior(Protocol):
    """Of unknowns x (p,), given readings that were rounded."""

    def at(self, x: Array, noise_std: float) -> Generator[None, None, Place]:
        """What it is at x with noise of this deviation beside the rounding, in pieces."""


def climbed(
    posterior: LogPosterior, x: Array, noise_std: float, least: float,
) -> Generator[None, None, tuple[Array, float, float]]:
    """The most likely x (p,), beginning with this one, its log-posterior, and the likeliest noise.

    noise_std: with which it begins. least: below which none is tried.
    """
    best = (x, -np.inf, noise_std)
    while noise_std >= least:
        x, value = yield from climbed_at(posterior, x, noise_std)
        if not value > best[1]:
            break
        best = (x, value, noise_std)
        noise_std *= QUIETER
    return best


def climbed_at(
    posterior: LogPosterior, x: Array, noise_std: float,
) -> Generator[None, None, tuple[Array, float]]:
    """The most likely x (p,) for this noise, beginning with this one, and its log-posterior."""
    here = yield from posterior.at(x, noise_std)
    for _ in range(NEWTON_STEPS):
        _, step, failed = lapack.dposv(here.precision, here.gradient)
        if failed or not here.gradient @ step > GAIN:
            break
        length = 1.0
        there = yield from posterior.at(x + step, noise_std)
        while not there.value > here.value and length > SHORTEST:
            length *= SHORTER
            there = yield from posterior.at(x + length * step, noise_std)
        if not there.value > here.value:
            break
        x, here = x + length * step, there
    return x, here.value
