"""Outer search over the gap: for each gap the best start and model, then the best few set free.

The squares left over have a local minimum wherever a turn of p passes a sample: a search from one
start alone would end in any of them. Models for a known play output come from Steiglitz and
McBride: A y = B p + e + X with p and y filtered by 1/A of the step before, from several first
filters. What is left is white where the noise of y is, so that the poles are not biased as those of
a plain ARX fit are.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.output_error import (
    SINGULAR,
    Fit,
    Samples,
    Structure,
    best_start,
    fit,
    linear_rows,
    solved,
    squares_of,
    triangle,
)
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

NEAR = np.linspace(0.8, 1.2, 11)  # gaps around a minimum, relative
STARTS = (0.0, 0.5, 1.0)  # places in the gap at which p may begin
GAPS = 32  # that are compared over the swing of v
MINIMA = 3  # that are looked at closely
ANEW = 4  # gaps from one model from scratch to the next, three times as many near a known one
INSIDE = 0.999  # a pole outside of the unit circle is put back to here
FILTERS, STEPS = (0.6, 0.95), 4  # poles of the first filter; steps from each


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
    swing = samples.swing
    gaps: Array = np.append(0.0, np.geomspace(2e-3, 0.98, GAPS) * swing)
    first = yield from profile(samples, structure, gaps)
    found: list[Fit] = []
    for minimum in first.minima()[:MINIMA]:
        around = np.array([gap for gap in minimum.point.gap * NEAR if gap < swing])
        if not minimum.point.gap or not len(around):
            found.append(fit(samples, structure, minimum.point))
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
        if number % (ANEW if known is None else 3 * ANEW) == ANEW - 1 or not models:
            p = samples.played(gap, starts[len(starts) // 2])
            models = [*models, *steiglitz_mcbride(samples, structure, p)[:1]]
        best = best_start(samples, structure, models, gap, starts)
        # The next gap goes on from this model.
        fits.append(fit(samples, structure, best, gap_free=False, iterations=2))
        models = [fits[-1].point.a]
        yield
    return Profile(gaps, np.array([found.squares for found in fits]), fits)


def steiglitz_mcbride(
    samples: Samples, structure: Structure, p: Array, filters: Sequence[float] = FILTERS,
) -> list[Array]:
    """Free coefficients of A, the best first; at least one. filters: poles of the first ones."""
    tried: list[tuple[float, int, Array]] = []
    known = samples.known
    y = np.interp(np.arange(samples.count), known, samples.y[known]) - samples.middle
    for first in filters:
        a = np.atleast_1d(np.poly(np.full(structure.free_poles, first)))[1:]
        for step in range(STEPS):
            # Two steps later it is compared with others.
            if step >= 2 or not structure.free_poles:
                tried.append((squares_of(samples, structure, a, p), len(tried), a))
            better = _refined(samples, structure, a, p, y)
            if better is None:
                break
            a = better
    if not tried:
        tried.append((inf, 0, np.zeros(structure.free_poles)))
    return [a for _, _, a in sorted(tried, key=lambda one: one[:2])]


def _refined(
    samples: Samples, structure: Structure, a: Array, p: Array, y: Array,
) -> Array | None:
    """One step: the least squares in A and B with everything filtered by 1/A."""
    count, poles = samples.count, structure.free_poles
    if not poles:
        return None
    # A y over A: with an integrator in both, 1 - 1/z cancels.
    filtered = lfilter([1.0], np.append(1.0, a), y)
    back = np.zeros((poles, count))
    for j in range(poles):
        back[j, j + 1:] = -filtered[:count - j - 1]
    rows = np.vstack([linear_rows(samples, structure, a, p), back, filtered])
    r, scale = triangle(samples.reduced(rows))
    upper = r[:-1, :-1]
    if not np.abs(np.diag(upper)).min() > SINGULAR:
        return None
    a = (solved(upper, r[:-1, -1]) * scale[-1] / scale[:-1])[-poles:]
    return stable(a) if np.isfinite(a).all() else None


def stable(a: Array) -> Array:
    """The same with poles outside of the unit circle put inside."""
    poles = np.roots(np.append(1.0, a))
    size = np.abs(poles)
    if not len(poles) or size.max() <= INSIDE:
        return a
    poles = np.where(size > INSIDE, poles / np.maximum(size, 1e-12) * INSIDE, poles)
    return np.real(np.poly(poles))[1:]
