"""Which order, delay and integrator: compared on samples that the fit has not seen.

A pole that a zero cancels is none: such a structure gives way to the same one without that pole. It
would predict a little better, but only what no G makes: the state and the offset that fit the
samples held out would have a drift more to fit them with. Structures whose held-out error is
within a few percent of the least, or within its own deviation, are equally good predictors. Among
them the least

    N' log(squares) + unknowns log(N)

over all samples is taken (BIC), with N' = N (1 - r) / (1 + r) for the lag-1 correlation r of the
residual: what repeats itself from sample to sample, as the error of a quantised y, speaks less.

Without any noise the residual is what the arithmetic of the simulation rounds, and says nothing of
the structure. Of the structures that explain y to within their own rounding, the smallest is taken.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.gap_search import FILTERS, steiglitz_mcbride
from backlash_ros.core.identification.output_error import (
    Fit,
    Point,
    Samples,
    Structure,
    best_start,
    fit,
    solved,
    triangle,
)
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

WITHIN = 1.05  # times the least held-out error: equally good
STARTS = (0.0, 0.33, 0.67, 1.0)  # places in the gap at which p may begin
CANCELS = 0.02  # distance of a pole and a zero that cancel, relative to that of the pole from 1
SLOWEST = 0.01  # ... which counts as this much at least: a zero at 1 cancels an integrator
EPS, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
RACE = 1200  # rows that tell which structures may be the best
FEW_STEPS = 4  # of a fit that tells whether a structure may be the best
FINALISTS = 4  # by the criterion, and as many by prediction
ROUNDED = 2.0  # the simulated y, and the measured one, which may be a simulation as well
AS_WELL = 4.0  # ratio of the squares left over: without noise, it shows a pole that is cancelled
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good


class Compared(NamedTuple):
    """One structure.

    trained: fitted to the first part, with which held_out, the rms of the error on the last part,
    is made; scatter: relative deviation of that. fit: to all samples. criterion: as above, the
    smaller the better, inf where it was not fitted to the end. exact: whether the residual is no
    more than the rounding of the simulation.
    """

    structure: Structure
    held_out: float
    trained: Fit
    fit: Fit
    criterion: float
    exact: bool
    scatter: float = 0.0


def compare(
    samples: Samples, candidates: Sequence[Point], orders: Sequence[int], delays: Sequence[int],
    integrators: Sequence[bool], held_out: float,
) -> Generator[None, None, list[Compared]]:
    """Fit every structure, from gaps and starts that are about right; yields between them.

    A few steps tell which structures may be the best; only these are fitted to the end. held_out:
    share at the end of the record that is compared on.
    """
    cut = samples.last - round(held_out * samples.count)
    train, later = samples.part(samples.first, cut), samples.part(cut, samples.last)
    structures = [
        Structure(order, delay, integrator) for integrator in integrators for delay in delays
        for order in orders if order >= integrator
    ]
    coarse = train.coarse(RACE)
    first: dict[Structure, Compared] = {}
    for structure in structures:
        begin = _modelled(coarse, structure, candidates[0], FILTERS[1:])
        found = fit(coarse, structure, begin, iterations=FEW_STEPS)
        first[structure] = _compared(found, found, coarse, later)
        yield
    first = _with_criteria(first, coarse)
    done: dict[Structure, Compared] = {}
    for structure in _finalists(first):
        begins = [first[structure].trained.point]
        begins += [_modelled(train, structure, point) for point in candidates[1:]]
        below = done.get(structure._replace(order=structure.order - 1))
        if below is not None:
            begins += _with_a_pole(below.trained.point)
        some = [fit(train, structure, begin, iterations=FEW_STEPS) for begin in begins]
        found = fit(train, structure, min(some, key=lambda one: one.squares).point)
        done[structure] = _compared(found, fit(samples, structure, found.point), samples, later)
        yield
    done = _with_criteria(done, samples)
    return [done.get(structure, first[structure]._replace(criterion=inf, exact=False))
            for structure in structures]


def _compared(trained: Fit, whole: Fit, samples: Samples, later: Samples) -> Compared:
    error = (later.y - predicted(trained, later))[later.known]
    return Compared(
        whole.structure, _rms(error), trained, whole, inf, whole.rms <= rounding(samples, whole),
        1.0 / float(np.sqrt(2.0 * _effective(error))),
    )


def _with_criteria(
    compared: Mapping[Structure, Compared], samples: Samples,
) -> dict[Structure, Compared]:
    best = min((one.fit for one in compared.values()), key=lambda whole: whole.squares)
    rows = effective_rows(samples, best)
    return {structure: one._replace(
        criterion=rows * float(np.log(max(one.fit.squares, TINY)))
        + structure.unknowns * float(np.log(len(samples.target))),
    ) for structure, one in compared.items()}


def _finalists(first: Mapping[Structure, Compared]) -> list[Structure]:
    """Structures that may be the best by either measure, with those that they may give way to."""
    by_criterion = sorted(first, key=lambda s: first[s].criterion)
    by_prediction = sorted(first, key=lambda s: first[s].held_out)
    good = {*by_criterion[:FINALISTS], *by_prediction[:FINALISTS]}
    good |= {best._replace(delay=s.delay) for best in by_criterion[:1] for s in first}
    for _ in range(2):  # what they give way to may have a pole that is cancelled as well
        for s in list(good):
            good |= {Structure(s.order - 1, s.delay, also) for also in (False, s.integrator)}
    return [structure for structure in first if structure in good]


def selected(compared: Sequence[Compared]) -> Compared:
    """The structure that is taken."""
    compared = [one for one in compared if np.isfinite(one.criterion)]
    needed = [one for one in compared if not gives_way(one.fit, compared)]
    # What a pole near 1 rounds may hide noise: without it, y is explained as well.
    exact = [one for one in compared if one.exact and not gives_way(one.fit, [
        other for other in compared if other.fit.squares < AS_WELL * one.fit.squares
    ])]
    if exact:
        return min(exact, key=lambda one: (one.structure.unknowns, one.fit.squares))
    least = min(needed, key=lambda one: one.held_out)
    within = least.held_out * max(WITHIN, 1.0 + least.scatter)
    good = [one for one in needed if one.held_out <= within]
    return min(good, key=lambda one: one.criterion)


def gives_way(found: Fit, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole, and the structure without that pole is compared as well."""
    order, delay, integrator, _ = found.structure
    smaller = [
        Structure(order - 1, delay, integrator and pole != 1.0) for pole in cancelled_poles(found)
    ]
    return any(one.structure in smaller for one in compared)


def cancelled_poles(found: Fit) -> list[complex]:
    """Poles that a zero all but cancels, so that neither shows; an integrator as exactly 1."""
    zeros = np.roots(found.numerator)
    if not len(zeros) or not np.isfinite(zeros).all():
        return []
    poles = [*np.roots(np.append(1.0, found.point.a)), *[1.0] * found.structure.integrator]
    return [
        complex(pole) for pole in poles
        if float(np.abs(zeros - pole).min()) < CANCELS * max(abs(1.0 - pole), SLOWEST)
    ]


def rounding(samples: Samples, found: Fit) -> float:
    """Deviation of the simulated y by rounding alone.

    A step of the recursion A y = ... rounds by |A|_1 |y| eps at most, and 1/A hands that on.
    """
    impulse = np.zeros(samples.count)
    impulse[0] = 1.0
    answer = lfilter([1.0], found.denominator, impulse)
    y = float(np.sqrt(np.mean(samples.target**2)))
    return ROUNDED * EPS * float(np.abs(found.denominator).sum()) * y * float(
        np.linalg.norm(answer)
    )


def equal_delays(compared: Sequence[Compared], chosen: Compared) -> list[int]:
    """Delays that explain y as well as the chosen one, with as many poles or more.

    A lag that a pole of its own would make may stand for a delay.
    """
    order, _, integrator, _ = chosen.structure
    return sorted({
        one.structure.delay for one in compared
        if one.structure.integrator == integrator and one.structure.order >= order
        and one.criterion <= chosen.criterion + PLATEAU
    })


def _modelled(
    samples: Samples, structure: Structure, point: Point, filters: Sequence[float] = FILTERS,
) -> Point:
    """A model for a gap, and where p began with it."""
    p = samples.played(point.gap, point.start)
    models = steiglitz_mcbride(samples, structure, p, filters)[:1]
    if len(point.a) == structure.free_poles:
        models.append(point.a)
    # A state of fewer numbers does not hide a start that is wrong.
    v0 = float(samples.v[0])
    starts = [point.start, *(v0 + share * point.gap for share in STARTS)]
    return best_start(samples, structure, models, point.gap, starts)


def _with_a_pole(point: Point) -> list[Point]:
    """Points of the next order."""
    return [
        point._replace(a=np.convolve(np.append(1.0, point.a), (1.0, -pole))[1:])
        for pole in (0.3, 0.85)
    ]


def _rms(error: Array) -> float:
    rms = float(np.sqrt(np.mean(error**2)))
    return rms if np.isfinite(rms) else inf


def predicted(found: Fit, later: Samples) -> Array:
    """Simulation over samples (M,), begun in the state and with the offset that fit them best."""
    structure, count = found.structure, later.count
    one = np.zeros(count)
    one[0] = 1.0
    p = later.delayed(later.played(found.point.gap, found.point.start), structure.delay)
    denominator = found.denominator
    simulated = lfilter(found.numerator, denominator, p - found.centre) + later.middle
    impulse = lfilter([1.0], denominator, one)
    rows = np.zeros((1 + structure.state_terms, count))
    rows[0] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        rows[1 + i, i:] = impulse[:count - i]
    error = np.where(np.isfinite(later.y), later.y - simulated, 0.0)
    r, scale = triangle(np.vstack([later.reduced(rows), later.reduced(error)]))
    return np.asarray(simulated + (solved(r[:-1, :-1], r[:-1, -1]) * scale[-1] / scale[:-1]) @ rows)


def effective_rows(samples: Samples, found: Fit) -> float:
    """N' of the formula above."""
    return _effective(samples.target - samples.reduced(found.simulated - samples.middle))


def _effective(residual: Array) -> float:
    r = lag_one(residual)
    return len(residual) * (1.0 - r) / (1.0 + r)


def lag_one(residual: Array) -> float:
    """Correlation of the residuals (R,) of successive rows, at least 0."""
    energy = float(np.mean(residual**2))
    if energy == 0.0 or not np.isfinite(energy) or len(residual) < 2:
        return 0.0
    return min(max(float(np.mean(residual[1:] * residual[:-1])) / energy, 0.0), 0.99)
