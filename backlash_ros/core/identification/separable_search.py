"""Outer search over the gap: for each gap the best start and model, then the best few set free.

The squares left over have a local minimum wherever a turn of p passes a sample: a search from one
start alone would end in any of them.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.output_error import (
    Fit,
    Point,
    Samples,
    Structure,
    fit,
    squares_of,
)
from backlash_ros.core.identification.starting_models import steiglitz_mcbride

Array = NDArray[np.float64]

NEAR = np.linspace(0.8, 1.2, 13)  # gaps around a minimum, relative
STARTS = (0.0, 0.5, 1.0)  # places in the gap at which p may begin


class Profile(NamedTuple):
    """Squares left over for each gap, with everything else free. fits: of the same gaps."""

    gaps: Array
    squares: Array
    fits: Sequence[Fit]

    @property
    def best(self) -> Fit:
        """The fit with the least squares."""
        return self.fits[int(np.argmin(self.squares))]

    def minima(self) -> list[Fit]:
        """The fits at the local minima, the best first."""
        left = np.append(np.inf, self.squares[:-1])
        right = np.append(self.squares[1:], np.inf)
        found = np.flatnonzero((self.squares <= left) & (self.squares <= right))
        return [self.fits[i] for i in found[np.argsort(self.squares[found], kind='stable')]]


def search(samples: Samples, structure: Structure) -> Generator[None, None, list[Fit]]:
    """Fits with everything free from the best minima, the best first; yields between pieces."""
    swing = samples.play.swing
    gaps: Array = np.append(0.0, np.geomspace(2e-3, 0.98, 48) * swing)
    first = yield from profile(samples, structure, gaps)
    found: list[Fit] = []
    for minimum in first.minima()[:3]:
        around = np.array([gap for gap in minimum.point.gap * NEAR if gap < swing])
        if not len(around):
            found.append(minimum)
            continue
        near = yield from profile(samples, structure, around, minimum)
        found += [fit(samples, structure, better.point) for better in near.minima()[:2]]
        yield
    return sorted(found, key=lambda fit: fit.squares)


def profile(
    samples: Samples, structure: Structure, gaps: Array, known: Fit | None = None,
) -> Generator[None, None, Profile]:
    """The best fit for each gap. known: of which the model is a good start."""
    v0 = float(samples.v[0])
    fits: list[Fit] = []
    models = [] if known is None else [known.point.a]
    for number, gap in enumerate(gaps.tolist()):
        starts = [v0 + share * gap for share in (STARTS if gap > 0.0 else STARTS[:1])]
        if number % 4 == 0:  # a model from scratch
            p = samples.play.output(gap, starts[len(starts) // 2]).p
            models = [*models, *steiglitz_mcbride(samples, structure, p)[:1]]
        points = [Point(a, gap, start) for a in models for start in starts]
        best = min(points, key=lambda point: squares_of(samples, structure, point))
        # The next gap goes on from this model.
        fits.append(fit(samples, structure, best, gap_free=False, iterations=3))
        models = [fits[-1].point.a]
        yield
    return Profile(gaps, np.array([found.squares for found in fits]), fits)
