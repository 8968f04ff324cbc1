"""Which order, delay and integrator: compared on samples that the fit has not seen.

A pole that a zero cancels is none: such a structure gives way to the same one without that pole. It
would predict a little better, but only what no G makes: the state and the offset that fit the
samples held out would have a drift more to fit them with. Structures whose held-out error is
within a few percent of the least, or within its own deviation, are equally good predictors. Among
them the least

    N' log(squares) + unknowns log(N)

over all samples is taken (BIC), with N' = N (1 - r) / (1 + r) for the lag-1 correlation r of the
residual: what repeats itself from sample to sample, as the error of a quantised y, speaks less.
What the arithmetic of the simulation rounds says nothing of the structure: no error is less. A
structure with an oscillation that outlasts the record is taken only where all have one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import FIRST_STEPS
from backlash_ros.core.identification.deviations import effective
from backlash_ros.core.identification.structure import (
    TINY,
    Model,
    Samples,
    Structure,
    first_model,
    fitted,
    with_pole,
)
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]

RACE_STEPS = 10  # of a fit that tells whether a structure may be the best
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good


class Compared(NamedTuple):
    """One structure.

    trained: fitted to the first part, with which held_out, the rms of the error on the last part,
    is made; scatter: relative deviation of that. whole: fitted to all samples. criterion: as above,
    the smaller the better, inf where it was not fitted to the end.
    """

    structure: Structure
    held_out: float
    trained: Model
    whole: Model
    criterion: float = inf
    scatter: float = 0.0


def compare(
    samples: Samples, candidates: Sequence[Model], structures: Sequence[Structure], cut: int,
) -> list[Compared]:
    """Fit every structure, from models whose gap and beginning are about right.

    Ten steps on the first part tell which structures may be the best; only these are fitted to
    the end. cut: number of the first sample that is held out.
    """
    train, later = replace(samples, last=cut), replace(samples, first=cut)
    first: dict[Structure, Compared] = {}
    for kind in sorted({(s.integrator, s.order) for s in structures}):
        of_kind = [s for s in structures if (s.integrator, s.order) == kind]
        like = _of_all_delays(train, of_kind, candidates)
        for structure in of_kind:
            taps = like.numerator[structure.delay - like.structure.delay:]
            begin = replace(like.fit, theta=np.concatenate([
                like.fit.theta[:3], structure.xi(taps, like.a)]), x=np.zeros(1))
            found = fitted(train, structure, begin, RACE_STEPS)
            first[structure] = _compared(found, found, later)
    done: dict[Structure, Compared] = {}
    for structure in _finalists(_with_criteria(first.values())):
        trained = first[structure].trained
        begins = [trained.fit]
        smaller = done.get(replace(structure, order=structure.order - 1))
        if smaller is not None:
            begins += [with_pole(structure, smaller.trained, pole) for pole in (0.3, 0.85)]
        some = [fitted(train, structure, begin, FIRST_STEPS) for begin in begins]
        trained = min(some, key=lambda one: one.squares)
        done[structure] = _compared(trained, fitted(samples, structure, trained.fit), later)
    finished = {one.structure: one for one in _with_criteria(done.values())}
    return [finished.get(structure, first[structure]) for structure in structures]


def _of_all_delays(
    samples: Samples, structures: Sequence[Structure], candidates: Sequence[Model],
) -> Model:
    """A model with the poles of these structures, and a tap for each of their delays."""
    delays = [s.delay for s in structures]
    one = structures[0]
    general = replace(one, delay=min(delays), taps=one.numerator_taps + max(delays) - min(delays))
    begins = [first_model(samples, general, one.gap, one.fit.p0) for one in candidates]
    best = min(begins, key=lambda model: model.squares)
    return fitted(samples, general, best.fit, RACE_STEPS)


def _compared(trained: Model, whole: Model, later: Samples) -> Compared:
    error = (later.fitted_y() - predicted(trained, later))[np.isfinite(later.fitted_y())]
    rms = float(np.sqrt(np.mean(error**2)))
    return Compared(whole.structure, rms if np.isfinite(rms) else inf, trained, whole,
                    scatter=1.0 / sqrt(2.0 * effective(error)))


def _with_criteria(compared: Iterable[Compared]) -> list[Compared]:
    """The same with their criteria, and no error less than what is rounded."""
    compared = list(compared)
    best = min((one.whole for one in compared), key=lambda whole: whole.squares)
    count, rows, rounded = len(best.left), effective(best.left), rounding(best)
    return [one._replace(
        held_out=max(one.held_out, rounded),
        criterion=rows * log(max(one.whole.squares, rounded**2 * count, TINY))
        + one.structure.unknowns * log(count),
    ) for one in compared]


def _finalists(first: Sequence[Compared]) -> list[Structure]:
    """Structures that may be the best by either measure, with those that they may give way to."""
    finalists = 4  # by the criterion, and as many by prediction
    by_criterion = sorted(first, key=lambda one: one.criterion)
    by_prediction = sorted(first, key=lambda one: one.held_out)
    good = {one.structure for one in (*by_criterion[:finalists], *by_prediction[:finalists])}
    good |= {replace(by_criterion[0].structure, delay=one.structure.delay) for one in first}
    for _ in range(2):  # what they give way to may have a pole that is cancelled as well
        good |= {Structure(s.order - 1, s.delay, also)
                 for s in good for also in (False, s.integrator)}
    return [one.structure for one in first if one.structure in good]


def selected(compared: Sequence[Compared]) -> Compared:
    """The structure that is taken."""
    open_ = eligible(compared)
    needed = [one for one in open_ if not gives_way(one.whole, open_)]
    least = min(needed, key=lambda one: one.held_out)
    within = least.held_out * max(1.05, 1.0 + least.scatter)
    return min((one for one in needed if one.held_out <= within), key=lambda one: one.criterion)


def eligible(compared: Sequence[Compared]) -> list[Compared]:
    """Structures that were fitted to the end, without those that ring if there are others."""
    fitted_to_end = [one for one in compared if np.isfinite(one.criterion)]
    return [one for one in fitted_to_end if not rings(one.whole)] or fitted_to_end


def rings(found: Model) -> bool:
    """Whether an oscillation hardly dies out over the record: it explains what G does not."""
    lasting = 4.0  # time constants that a record has to be long
    poles = np.roots(np.append(1.0, found.a))
    return bool(np.any((poles.imag != 0.0) & (abs(poles) > 1.0 - lasting / len(found.problem.v))))


def gives_way(found: Model, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole, and the structure without that pole is compared as well."""
    s = found.structure
    smaller = [
        Structure(s.order - 1, s.delay, s.integrator and pole != 1.0)
        for pole in cancelled_poles(found)
    ]
    # One that explains far less has been fitted badly.
    return any(one.structure in smaller and one.whole.squares <= 2.0 * found.squares
               for one in compared)


def cancelled_poles(found: Model) -> list[complex]:
    """Poles that a zero all but cancels, so that neither shows; an integrator as exactly 1."""
    if not np.isfinite(found.numerator).all():
        return []
    zeros = np.roots(found.numerator)
    poles = [*np.roots(np.append(1.0, found.a)), *[1.0] * found.structure.integrator]
    # Within 2 % of the distance of the pole from 1; a zero at 1 cancels an integrator.
    return [
        complex(pole) for pole in poles
        if float(np.abs(zeros - pole).min(initial=inf)) < 0.02 * max(abs(1.0 - pole), 0.01)
    ]


def rounding(found: Model) -> float:
    """Deviation of the simulated y, and of one that was measured in a simulation, by rounding.

    A step of the recursion A y = ... rounds by |A|_1 |y| eps at most, and 1/A hands that on.
    """
    impulse = np.zeros(len(found.problem.v))
    impulse[0] = 1.0
    answer = lfilter([1.0], found.denominator, impulse)
    y = float(np.sqrt(np.mean(found.problem.y**2)))
    size = float(np.abs(found.denominator).sum() * np.linalg.norm(answer))
    return 2.0 * float(np.finfo(float).eps) * y * size


def equal_delays(compared: Sequence[Compared], chosen: Compared) -> list[int]:
    """Delays that explain y as well as the chosen one, with as many poles or more.

    A lag that a pole of its own would make may stand for a delay.
    """
    taken = chosen.structure
    return sorted({
        one.structure.delay for one in compared
        if one.structure.integrator == taken.integrator and one.structure.order >= taken.order
        and one.criterion <= chosen.criterion + PLATEAU
    })


def predicted(found: Model, later: Samples) -> Array:
    """Simulation over samples (M,), begun in the state and with the offset that fit them best."""
    begin = replace(found.fit, x=np.zeros(1), p0=float(found.p[-1]))
    return later.problem(found.structure).explained(begin)
