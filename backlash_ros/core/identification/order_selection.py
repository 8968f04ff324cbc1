"""Which order, delay and integrator: compared on samples that the fit has not seen.

A pole that a zero cancels is none: such a structure gives way to the same one without that pole. It
would predict a little better, but only what no G makes: the state and the offset that fit the
samples held out would have a drift more to fit them with. Structures whose held-out error is
within a few percent of the least, or within its own deviation, are equally good predictors. Among
them the least

    N' log(squares) + unknowns log(N)

over all samples is taken (BIC), with N' = N (1 - r) / (1 + r) for the lag-1 correlation r of the
residual: what repeats itself from sample to sample, as the error of a quantised y, speaks less.
What the arithmetic of the simulation rounds says nothing of the structure: no error is less.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.play import play
from backlash_ros.core.identification.output_error import (
    FILTERS,
    TINY,
    Fit,
    Point,
    Samples,
    Structure,
    best_start,
    fit,
    linear_rows,
    solved,
    steiglitz_mcbride,
    triangle,
)
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

RACE_STEPS = 4  # of a fit that tells whether a structure may be the best
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good


class Compared(NamedTuple):
    """One structure.

    trained: fitted to the first part, with which held_out, the rms of the error on the last part,
    is made; scatter: relative deviation of that. fit: to all samples. criterion: as above, the
    smaller the better, inf where it was not fitted to the end.
    """

    structure: Structure
    held_out: float
    trained: Fit
    fit: Fit
    criterion: float = inf
    scatter: float = 0.0


def compare(
    samples: Samples, candidates: Sequence[Point], structures: Sequence[Structure],
    held_out: float,
) -> list[Compared]:
    """Fit every structure, from gaps and starts that are about right.

    A few steps tell which structures may be the best; only these are fitted to the end. held_out:
    share at the end of the record that is compared on.
    """
    cut = samples.last - round(held_out * samples.count)
    train, later = replace(samples, last=cut), replace(samples, first=cut)
    coarse = replace(train, most=800)
    first: dict[Structure, Compared] = {}
    for structure in structures:
        begin = _modelled(coarse, structure, candidates[0], FILTERS[1:])
        found = fit(coarse, structure, begin, RACE_STEPS)
        first[structure] = _compared(found, found, later)
    nearest = min((one.trained for one in first.values()), key=lambda one: one.squares).point
    done: dict[Structure, Compared] = {}
    for structure in _finalists(_with_criteria(first.values())):
        begins = [first[structure].trained.point, nearest._replace(
            a=first[structure].trained.point.a)]
        # Averaged rows say little of what is as fast as they are.
        begins += [_modelled(train, structure, point) for point in (nearest, *candidates[1:])]
        below = done.get(structure._replace(order=structure.order - 1))
        if below is not None:
            a = np.append(1.0, below.trained.point.a)
            begins += [below.trained.point._replace(a=np.convolve(a, (1.0, -pole))[1:])
                       for pole in (0.3, 0.85)]
        some = [fit(train, structure, begin, RACE_STEPS) for begin in begins]
        a, gap, start = min(some, key=lambda one: one.squares).point
        # A state of fewer numbers does not hide a start that is wrong.
        found = fit(train, structure, best_start(
            train, structure, [a], gap, (0.0, 0.33, 0.67, 1.0), start))
        done[structure] = _compared(found, fit(samples, structure, found.point), later)
    finished = {one.structure: one for one in _with_criteria(done.values())}
    return [finished.get(structure, first[structure]) for structure in structures]


def _modelled(
    samples: Samples, structure: Structure, point: Point, filters: Sequence[float] = FILTERS,
) -> Point:
    """A model for a gap, and where p began with it."""
    models = steiglitz_mcbride(
        samples, structure, play(samples.v, point.gap, point.start), filters)[:1]
    if len(point.a) == structure.free_poles:
        models.append(point.a)
    return best_start(samples, structure, models, point.gap, (0.5,), point.start)


def _compared(trained: Fit, whole: Fit, later: Samples) -> Compared:
    error = (later.y - predicted(trained, later))[later.known]
    rms = float(np.sqrt(np.mean(error**2)))
    return Compared(whole.structure, rms if np.isfinite(rms) else inf, trained, whole,
                    scatter=1.0 / sqrt(2.0 * _effective(error)))


def _with_criteria(compared: Iterable[Compared]) -> list[Compared]:
    """The same with their criteria, and no error less than what is rounded."""
    compared = list(compared)
    best = min((one.fit for one in compared), key=lambda whole: whole.squares)
    rows, rounded = effective_rows(best), rounding(best)
    return [one._replace(
        held_out=max(one.held_out, rounded),
        criterion=rows * log(max(one.fit.squares, rounded**2 * best.rows, TINY))
        + one.structure.unknowns * log(best.rows),
    ) for one in compared]


def _finalists(first: Sequence[Compared]) -> list[Structure]:
    """Structures that may be the best by either measure, with those that they may give way to."""
    finalists = 4  # by the criterion, and as many by prediction
    by_criterion = sorted(first, key=lambda one: one.criterion)
    by_prediction = sorted(first, key=lambda one: one.held_out)
    good = {one.structure for one in (*by_criterion[:finalists], *by_prediction[:finalists])}
    good |= {by_criterion[0].structure._replace(delay=one.structure.delay) for one in first}
    for _ in range(2):  # what they give way to may have a pole that is cancelled as well
        good |= {Structure(s.order - 1, s.delay, also)
                 for s in good for also in (False, s.integrator)}
    return [one.structure for one in first if one.structure in good]


def selected(compared: Sequence[Compared]) -> Compared:
    """The structure that is taken."""
    needed = [one for one in compared
              if np.isfinite(one.criterion) and not gives_way(one.fit, compared)]
    least = min(needed, key=lambda one: one.held_out)
    within = least.held_out * max(1.05, 1.0 + least.scatter)
    return min((one for one in needed if one.held_out <= within), key=lambda one: one.criterion)


def gives_way(found: Fit, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole, and the structure without that pole is compared as well."""
    order, delay, integrator, _ = found.structure
    smaller = [
        Structure(order - 1, delay, integrator and pole != 1.0) for pole in cancelled_poles(found)
    ]
    # One that explains far less has been fitted badly.
    return any(one.structure in smaller and one.fit.squares < 2.0 * found.squares
               for one in compared if np.isfinite(one.criterion))


def cancelled_poles(found: Fit) -> list[complex]:
    """Poles that a zero all but cancels, so that neither shows; an integrator as exactly 1."""
    if not np.isfinite(found.numerator).all():
        return []
    zeros = np.roots(found.numerator)
    poles = [*np.roots(np.append(1.0, found.point.a)), *[1.0] * found.structure.integrator]
    # Within 2 % of the distance of the pole from 1; a zero at 1 cancels an integrator.
    return [
        complex(pole) for pole in poles
        if float(np.abs(zeros - pole).min(initial=inf)) < 0.02 * max(abs(1.0 - pole), 0.01)
    ]


def rounding(found: Fit) -> float:
    """Deviation of the simulated y, and of one that was measured in a simulation, by rounding.

    A step of the recursion A y = ... rounds by |A|_1 |y| eps at most, and 1/A hands that on.
    """
    impulse = np.zeros(found.samples.count)
    impulse[0] = 1.0
    answer = lfilter([1.0], found.denominator, impulse)
    y = float(np.sqrt(np.mean(found.samples.target**2)))
    size = float(np.abs(found.denominator).sum() * np.linalg.norm(answer))
    return 2.0 * float(np.finfo(float).eps) * y * size


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


def predicted(found: Fit, later: Samples) -> Array:
    """Simulation over samples (M,), begun in the state and with the offset that fit them best."""
    taps = found.structure.numerator_taps
    p = play(later.v, found.point.gap, found.point.start)
    rows = linear_rows(later, found.structure, found.point.a, p)
    moved = found.numerator @ rows[:taps]
    error = later.target - later.reduced(moved)
    rest = solved(triangle(np.vstack([later.reduced(rows[taps:]), error])))
    return np.asarray(moved + rest @ rows[taps:] + later.middle)


def effective_rows(found: Fit) -> float:
    """N' of the formula above."""
    samples = found.samples
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
