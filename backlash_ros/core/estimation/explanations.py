"""What explains a record best: a backlash found from nothing, and whether it counts as known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.fit import FIRST_STEPS, Problem
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import Fit, Prior, Start
from backlash_ros.core.estimation.search import search
from backlash_ros.core.estimation.settings import (
    AS_GOOD,
    CHANCE,
    ENGAGED,
    GATE,
    NO_GAP,
    OUTLIER_SHARE,
    OUTLIERS,
    REVERSALS,
    STD_GAP,
    STD_SLOPE,
    SYSTEMATIC,
    UNEXPLAINED,
)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CANDIDATES = 6  # best gaps of a search that are fitted
BEGINNINGS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the play in its gap, that are compared with a fit
WALKS = (0.005, 0.02, 0.08)  # of u over the whole record, over m times the gap, that are compared
WALKING = 30.0  # log-likelihood by which a walk must be better than none
APART = 0.02  # relative difference of two gaps that are two candidates
FAR_BEHIND = 30.0  # log-likelihood by which a candidate is given up after a few steps
BY_CHANCE = 3.0  # standard deviations by which an estimate may lie beyond a bound
# --- guards
FIRST_NOISE = 0.05  # noise of a first step, over the deviation of y
SMALLEST_NOISE = 1e-12  # of y, that a setup may have
BOUND_ROUNDING = 1e-9  # relative distance from a bound that is none


@dataclass(frozen=True)
class Setup:
    """What is known before the first sample.

    noise_std: of y, nominal. widest: gap that is considered. guess: gap of the first guess.
    walk_std: of u, drift: of m, c_r, c_l (3,), both per square root of a sample.
    """

    family: PlantFamily
    noise_std: float
    bounds: Bounds
    widest: float
    guess: float
    walk_std: float
    drift: Array


class Record(NamedTuple):
    """Samples from number `first` on: v that acted, y after it (nan: lost), v that may have acted
    instead (nan: none), all (N,)."""

    first: int
    v: Array
    y: Array
    other: Array

    @property
    def end(self) -> int:
        """Number of the sample after the last one."""
        return self.first + len(self.v)

    def since(self, first: int) -> Record:
        """The samples from this number on."""
        at = max(first - self.first, 0)
        return Record(self.first + at, self.v[at:], self.y[at:], self.other[at:])

    def until(self, end: int) -> Record:
        """The samples before this number."""
        count = max(end - self.first, 0)
        return Record(self.first, self.v[:count], self.y[:count], self.other[:count])


def with_swapped(record: Record, numbers: frozenset[int]) -> Record:
    """The record where the other command acted over the intervals of these samples."""
    places = [k - record.first for k in numbers if record.first <= k < record.end]
    if not places:
        return record
    v, other = record.v.copy(), record.other.copy()
    v[places], other[places] = record.other[places], record.v[places]
    return record._replace(v=v, other=other)


def problem_of(
    setup: Setup, record: Record, older: Prior | None = None, start: Start | None = None,
    most_scale: float = np.inf, walk_std: float = 0.0,
) -> Problem:
    """The fit of a record by this setup."""
    return Problem(setup.family, record.v, record.y, setup.noise_std, older, start, most_scale,
                   max(walk_std, setup.walk_std))


def afresh(
    setup: Setup, record: Record, of_xi: Prior | None = None, xi: Array | None = None,
    most_scale: float = np.inf, also: Fit | None = None, walks: bool = False,
) -> Fit | None:
    """The best fit from nothing, mixed with other gaps that fit about as well; None for none.

    of_xi: rows on theta that are known, around xi (K,). also: where to begin as well. walks:
    whether u may walk. A fit with m < 0 says that y goes the other way.
    """
    family = setup.family
    if np.isfinite(record.y).sum() < 15 + 2 * family.count or np.ptp(record.v) == 0.0:
        return None
    found, null = search(family, record.v, record.y, setup.noise_std, setup.widest)
    if not found or found[0].evidence < null + ENGAGED:
        return None
    p = problem_of(setup, record, of_xi, most_scale=most_scale)
    noise = max(setup.noise_std, FIRST_NOISE * float(np.nanstd(record.y)))
    fits: list[Fit] = []
    gaps: list[float] = []
    begin = np.zeros(family.count) if xi is None else xi
    sign = 1.0 if found[0].m > 0.0 else -1.0
    for _, gap, p0, m in found:
        if len(gaps) == CANDIDATES:
            break
        if m * sign > 0.0 and all(abs(gap - other) > APART * other for other in gaps):
            gaps.append(gap)
            theta = np.concatenate([[m, m * (p0 - record.v[0]), gap], begin])
            start = p.step(Fit(np.zeros(1), p0, theta, noise), 1.0, held=True)
            fits.append(p.finished(p.fitted(start, FIRST_STEPS)))
    if also is not None and also.m > 0.0:
        begins = replace(also.without_intervals, x=np.zeros(1))
        fits.append(p.finished(p.fitted(begins, FIRST_STEPS)))
    fits = [f for f in fits if np.isfinite(f.evidence)]
    if not fits:
        return None
    fits = p.comparable(fits)
    top = max(f.evidence for f in fits)
    fits = [p.finished(p.fitted(f)) if f.evidence > top - FAR_BEHIND else f for f in fits]
    fits = p.comparable(fits)
    best = max(fits, key=lambda f: f.evidence)
    if best.m < 0.0:
        return best
    best = _begun_elsewhere(p, best)
    apart, best = spread(best, fits), p.with_intervals(best)
    return replace(with_walk(p, best) if walks else best, spread=apart)


def with_walk(p: Problem, f: Fit) -> Fit:
    """The fit, or one where u walks as well if that explains why residuals are correlated.

    One that walks already is compared with one that does not in the same way.
    """
    best = f
    if f.walk_std:
        still = p.walking(0.0)
        best = still.with_intervals(still.fitted(f.without_intervals))
    if not best.valid or not best.systematic:
        return best
    for share in WALKS:
        walking = p.walking(share * f.m * f.gap / sqrt(len(p.v)))
        begin = replace(f.without_intervals, knots=np.zeros(0))
        g = walking.with_intervals(walking.fitted(begin, FIRST_STEPS))
        of_best, of_g = (each.evidence for each in walking.comparable([best, g]))
        if g.valid and of_g > of_best + (0.0 if best.walk_std else WALKING):
            best = g
    return best


def _begun_elsewhere(p: Problem, f: Fit) -> Fit:
    """The fit, or one with another beginning: y has a minimum wherever v has turned meanwhile."""
    first = float(p.v[0])
    likeliest, value = f, p.log_posterior(f) + 1.0
    weights = p.weights(p.output(f))
    for share in BEGINNINGS:
        other = replace(f, p0=first + share * f.gap, x=np.zeros(len(f.x)))
        other = replace(other, x=p.state(other))
        of_other = p.log_posterior(other, weights)
        if of_other > value:
            likeliest, value = other, of_other
    return f if likeliest is f else p.finished(p.fitted(likeliest))


def spread(best: Fit, fits: list[Fit]) -> Array:
    """What the other fits add to the covariance of m, c_r, c_l around the best: their mixture."""
    valid = [f for f in fits if f.valid]
    share = np.exp([f.evidence - best.evidence for f in valid])
    share /= max(float(share.sum()), 1e-300)
    out = np.zeros((3, 3))
    for each, f in zip(share, valid, strict=True):
        apart = f.crossings - best.crossings
        out += each * np.outer(apart, apart)
    return out


def is_known(setup: Setup, f: Fit, turns: int) -> bool:
    """Whether m and the gap are known well enough to be published.

    turns: reversals of the engaged side that speak for it. While residuals are correlated the
    deviations must be smaller: what causes that does not average out. A gap is also known where
    its upper end is small beside the first guess: there is none.
    """
    if not f.valid or turns < (REVERSALS if setup.family.count else 1):
        return False
    if any(outside_bounds(setup.bounds, f)):
        return False
    if moves_unexplained(setup, f):
        return False
    factor = 1.0 / SYSTEMATIC if f.systematic else 1.0
    std_gap = f.gap_std
    no_gap = f.gap < BY_CHANCE * std_gap and f.gap + BY_CHANCE * std_gap < NO_GAP * setup.guess
    std_m, *of_crossings = f.crossings_std.tolist()
    gap_known = max(std_gap, *of_crossings) < factor * STD_GAP * f.gap
    return std_m < factor * STD_SLOPE * f.m and (gap_known or no_gap)


def moves_unexplained(setup: Setup, f: Fit) -> bool:
    """Whether y moves by more than is tolerated in a way that no G makes, where G is uncertain."""
    return f.systematic and f.unexplained > UNEXPLAINED and setup.family.count > 0


def noisier(setup: Setup, f: Fit) -> bool:
    """Whether readings are off by more than their configured noise, or their step, makes them."""
    return f.noise > AS_GOOD * max(setup.noise_std, f.step / sqrt(12.0))


def outside_bounds(bounds: Bounds, f: Fit) -> list[bool]:
    """Whether m, c_r, c_l lie outside of their bounds by more than chance."""
    values, std = f.crossings, f.crossings_std
    near = np.array(bounds.project(*values.tolist()))
    out: list[bool] = (
        np.abs(values - near) > BY_CHANCE * std + BOUND_ROUNDING * np.abs(values)
    ).tolist()
    return out


def agree(one: Array, other: Array, cov: Array) -> bool:
    """Whether two vectors (n,) differ by chance; cov: of their difference (n, n)."""
    from scipy.special import chdtri  # where fits are made: 31 MB

    apart = one - other
    squares = float(apart @ np.linalg.lstsq(cov, apart, rcond=1e-14)[0])
    return squares < float(chdtri(len(one), CHANCE))


def alike(one: Fit, other: Fit) -> bool:
    """Whether the backlashes of two fits differ by chance."""
    return agree(one.crossings, other.crossings, one.crossings_cov + other.crossings_cov)


def outliers(z: Array) -> Flags:
    """Which normalized residuals (N,) are outliers: few, and not many in a row; nan: lost."""
    wild = np.abs(z) > GATE
    if not wild.any():
        return wild
    if wild.sum() > OUTLIER_SHARE * np.isfinite(z).sum():
        return np.zeros_like(wild)
    known = np.flatnonzero(np.isfinite(z))
    rows = np.flatnonzero(np.diff(np.concatenate([[0], wild[known].astype(int), [0]])))
    for begin, end in zip(rows[::2], rows[1::2], strict=True):
        if end - begin >= OUTLIERS:
            wild[known[begin:end]] = False
    return wild


def of_xi(f: Fit, count: int) -> Prior | None:
    """What a fit knows of xi alone, as rows on theta; count: K."""
    if not count:
        return None
    cov = f.cov[3:, 3:] * f.inflation + 1e-12 * np.eye(count)
    root = np.linalg.inv(np.linalg.cholesky(cov))
    return Prior(np.hstack([np.zeros((count, 3)), root]), root @ f.theta[3:])
