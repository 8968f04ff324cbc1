"""Outer search over the gap: for each gap the best start and model, then the best few set free.

The squares left over have a local minimum wherever a turn of p passes a sample: a search from one
start alone would end in any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.play import play
from backlash_ros.core.identification.output_error import (
    Fit,
    Samples,
    Structure,
    best_start,
    fit,
    steiglitz_mcbride,
)

Array = NDArray[np.float64]

SEARCH_ROWS = 1200  # in which gaps are compared: of more samples, neighbours are averaged


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


def profile_of(fits: Sequence[Fit]) -> Profile:
    """Of fits, the gap rising."""
    fits = sorted(fits, key=lambda one: one.point.gap)
    return Profile(np.array([one.point.gap for one in fits]),
                   np.array([one.squares for one in fits]), fits)


def search(
    samples: Samples, structure: Structure, known: Fit | None = None,
) -> tuple[list[Fit], Profile]:
    """Fits to averaged rows with everything free from the best minima, the best first; all gaps.

    known: a fit of the same structure.
    """
    coarse = replace(samples, most=SEARCH_ROWS)
    swing = float(np.ptp(samples.v))
    gaps: Array = np.append(0.0, np.geomspace(2e-3, 0.98, 28) * swing)
    curve = _profile(coarse, structure, gaps, known)
    begins, fits = curve.minima()[:3], list(curve.fits)
    if known is not None:
        begins = [fit(coarse, structure, known.point), *begins[:2]]
        fits.append(begins[0])
    found = []
    for minimum in begins:
        around: Array = minimum.point.gap * np.linspace(0.8, 1.2, 11, dtype=np.float64)
        near = _profile(coarse, structure, around[(around > 0.0) & (around < swing)], minimum)
        fits += near.fits
        found += [fit(coarse, structure, one.point) for one in near.minima()[:2] or [minimum]]
    distinct: list[Fit] = []
    for one in sorted(found, key=lambda one: one.squares):
        gap = one.point.gap
        if all(abs(gap - other.point.gap) > 0.005 * other.point.gap for other in distinct):
            distinct.append(one)
    return distinct, profile_of(fits)


def _profile(samples: Samples, structure: Structure, gaps: Array, known: Fit | None) -> Profile:
    """The best fit for each gap. known: of which the model is a good start."""
    fits: list[Fit] = []
    models, shares = [] if known is None else [known.point.a], [0.0, 0.5, 1.0]
    for number, gap in enumerate(gaps.tolist()):
        if number % 4 == 0:  # a model and a start from scratch
            shares = [0.0, 0.5, 1.0]
            if not models or known is None:
                p = play(samples.v, gap, float(samples.v[0]) + 0.5 * gap)
                models += steiglitz_mcbride(samples, structure, p)[:1]
        begin = best_start(samples, structure, models, gap, shares)
        # The next gap goes on from this model, and from this place in it.
        fits.append(fit(samples, structure, begin, 2, gap_free=False))
        models, place = [fits[-1].point.a], fits[-1].point.start - float(samples.v[0])
        shares = [min(max(place / gap, 0.0), 1.0) if gap > 0.0 else 0.5]
    return profile_of(fits)
