"""Which order, delay and integrator G has: a search of the gap, and a race of structures.

    the gap with a general G  ->  orders, delays, integrators on held-out samples
    ->  the gap again with the one that is taken  ->  later delays, where these fit as well

A structure with a pole that a zero cancels gives way to the same one without that pole. Structures
whose held-out error is within a few percent of the least, or within its own deviation, are equally
good predictors; of these the least N' log(squares) + unknowns log(N') over all samples is taken
(BIC), with N' = N (1 - r) / (1 + r) for the lag-1 correlation r of the residual.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS
from backlash_ros.core.estimation.posterior import step_of
from backlash_ros.core.estimation.search import search
from backlash_ros.core.identification.model import (
    TINY,
    Model,
    Samples,
    Structure,
    by_model,
    effective,
    first_model,
    fitted,
    moved_to,
)
from backlash_ros.core.identification.not_play import Observed, what_it_is
from backlash_ros.core.identification.verdict import ANOTHER
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records.readings import noise_of, outliers, quantum

Progress = Callable[[str], object]
EARLY, LONGEST_DELAY = (0, 1, 2, 3), 40  # delays that are compared first, and the longest
GENERAL_POLES = 3  # of the G with which the gap is searched first; it has a tap for each delay
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good
RACE_STEPS = 10  # of a fit that tells whether a structure may be the best


@dataclass(frozen=True)
class Options:
    """What is compared. delays [samples]: none for EARLY, and later ones where these fit better.
    integrators: whether G has one. slope: m, which cannot be told from the gain of G. held_out:
    share of the record, its last."""

    orders: Sequence[int] = (0, 1, 2, 3, 4)
    delays: Sequence[int] = ()
    integrators: Sequence[bool] = (False, True)
    slope: float = 1.0
    held_out: float = 1.0 / 3.0


class Units(NamedTuple):
    """Middle and size of v and of y, by which both are centred and scaled."""

    v: float = 0.0
    v_size: float = 1.0
    y: float = 0.0
    y_size: float = 1.0


class Compared(NamedTuple):
    """One structure. trained: fitted to the first part, held_out: its rms error on the last part;
    scatter: relative deviation of that. whole: fitted to all samples. criterion: the smaller the
    better, inf where it was not fitted to the end."""

    structure: Structure
    held_out: float
    trained: Model
    whole: Model
    criterion: float = inf
    scatter: float = 0.0


class HeldOut(NamedTuple):
    """Prediction of samples (M,) that were not fitted, from `first` on; rms of its error, and of
    the fit to the samples before."""

    first: int
    measured: Array
    simulated: Array
    rms: float
    trained: float


class StructureSearch(NamedTuple):
    """The best of the structures that were compared, in scaled units. rivals: other minima (gap,
    how far behind). apart: deviation of the gap by models or delays that fit alike."""

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Model
    rivals: list[tuple[float, float]]
    held_out: HeldOut
    delays: Sequence[int]
    apart: float


def searched(
    v: Array, y: Array, options: Options, delays: Sequence[int], progress: Progress,
) -> StructureSearch:
    """The best structure with one of these delays."""
    far_off = 0.03  # relative distance of the last gap from the first, with which to begin anew
    progress('searching the gap')
    samples = Samples(v, y, max(delays) + 1, len(v), step_of(y))
    found = _with_general(samples, delays)
    kept = without_outliers(samples, found[0])
    # Where rounding is the least of what is left, readings are no intervals.
    kept = replace(kept, step=samples.step * (found[0].rms <= samples.step))
    if kept.y is not samples.y or kept.step != samples.step:
        samples = kept
        found = _with_general(samples, delays)
    cut = samples.last - round(options.held_out * len(samples.fitted_y))
    candidates = found[:2]
    structures = [
        Structure(order, delay, integrator) for integrator in options.integrators
        for delay in delays for order in options.orders if order >= integrator]
    for again in (True, False):
        progress('comparing orders and delays')
        compared = _compare(samples, candidates, structures, cut)
        progress('refining')
        for _ in structures:
            chosen = selected(compared)
            models = _of_gaps(samples, chosen.whole)
            best = models[0]
            if not gives_way(best, _eligible(compared)):
                break
            # Only the best fit of all shows that a pole is none.
            compared = [one._replace(whole=best) if one is chosen else one for one in compared]
        if not again or abs(best.gap - candidates[0].gap) <= far_off * best.gap:
            break
        candidates = [best, candidates[0]]  # the general G may have been a poor one
    rows = effective(best.left)
    rivals = [(one.gap, 0.5 * one.behind(best, rows)) for one in models
              if abs(one.gap - best.gap) > ANOTHER * best.gap]
    later = replace(samples, first=cut)
    held_out = HeldOut(cut, later.fitted_y, _predicted(chosen.trained, later), chosen.held_out,
                       chosen.trained.rms)
    return StructureSearch(
        samples, compared, chosen, best, rivals, held_out, delays, by_model(best.gap, [
            (one.whole.gap, one.criterion - chosen.criterion) for one in compared]))


def _with_general(samples: Samples, delays: Sequence[int]) -> list[Model]:
    """Models of different gaps, the best first, with a few poles and a tap for each delay."""
    general = Structure(
        GENERAL_POLES, min(delays), False, GENERAL_POLES + max(delays) - min(delays))
    swing = float(np.ptp(samples.v))
    begins = sorted(first_model(samples, general, gap, float(samples.v[0]) + 0.5 * gap)
                    for gap in (0.0, 0.05 * swing, 0.2 * swing, 0.5 * swing))
    best = fitted(samples, general, *(one.fit for one in begins[:2]), steps=FEW_STEPS)
    models = _of_gaps(samples, best)
    # Around another G the search may find another gap.
    if models[0].squares < 0.9 * best.squares and abs(models[0].gap - best.gap) > 0.1 * best.gap:
        models = _of_gaps(samples, models[0])
    return models


def _of_gaps(samples: Samples, like: Model) -> list[Model]:
    """Fits of the same structure to the minima over the gap, the best first."""
    most, apart = 4, 0.005  # minima that are fitted, and the relative distance of different ones
    smallest = 2e-3  # gap that is searched for, over the swing of v
    structure, problem = like.structure, like.problem
    y = np.where(problem.known, problem.y, nan)
    hypotheses, _ = search(structure, problem.v, y, 1e-12, 0.98 * float(np.ptp(problem.v)),
                           like.fit.theta[3:], smallest)
    begins, gaps = [like.fit], [like.gap]
    for _, gap, p0, _ in hypotheses:
        if len(begins) <= most and all(abs(gap - other) > ANOTHER * other for other in gaps):
            gaps.append(gap)
            begins.append(problem.step(moved_to(structure, like, gap, p0), held=True))
    some = sorted(fitted(samples, structure, begin, steps=FIRST_STEPS) for begin in begins)
    models: list[Model] = []
    for one in some:
        model = one if one.squares > 1.5 * some[0].squares else fitted(samples, structure, one.fit)
        if all(abs(model.gap - other.gap) > apart * other.gap for other in models):
            models.append(model)
    return sorted(models)


def without_outliers(samples: Samples, found: Model) -> Samples:
    """The same without readings that are none, by more than rounding: far off, or repeated."""
    y, simulated = samples.fitted_y, found.run.y
    step = quantum(y)
    same = np.append(False, np.diff(y) == 0.0)
    alone = same & ~np.append(False, same[:-1]) & ~np.append(same[1:], False)
    moves = np.abs(np.diff(simulated, prepend=simulated[0]))
    wild = outliers(found.problem.residual(found.fit), step) \
        | alone & (moves > max(step, 0.5 * found.rms))
    if not wild.any():
        return samples
    y = samples.y.copy()
    y[samples.first:samples.last][wild] = nan
    return replace(samples, y=y)


def _compare(
    samples: Samples, candidates: Sequence[Model], structures: Sequence[Structure], cut: int,
) -> list[Compared]:
    """Fit the structures, from models whose gap and beginning are about right: some steps on the
    samples before `cut` tell which may be the best, and only these are fitted to the end."""
    train, later = replace(samples, last=cut), replace(samples, first=cut)

    def compared(trained: Model, whole: Model) -> Compared:
        y = later.fitted_y
        error = (y - _predicted(trained, later))[np.isfinite(y)]
        rms = float(np.sqrt(np.mean(error**2)))
        return Compared(whole.structure, rms if np.isfinite(rms) else inf, trained, whole,
                        scatter=1.0 / sqrt(2.0 * effective(error)))

    first: dict[Structure, Compared] = {}
    for kind in sorted({(s.integrator, s.order) for s in structures}):
        alike = [s for s in structures if (s.integrator, s.order) == kind]
        # Poles of this order, and a tap for each of the delays.
        delays, one = [s.delay for s in alike], alike[0]
        general = replace(
            one, delay=min(delays), taps=one.numerator_taps + max(delays) - min(delays))
        best = min(first_model(train, general, like.gap, like.fit.p0) for like in candidates)
        like = fitted(train, general, best.fit, steps=RACE_STEPS)
        for structure in alike:
            taps = like.numerator[structure.delay - general.delay:]
            begin = replace(like.fit, theta=np.concatenate([
                like.fit.theta[:3], structure.xi(taps, like.a)]), x=np.zeros(1))
            found = fitted(train, structure, begin, steps=RACE_STEPS)
            first[structure] = compared(found, found)
    done: dict[Structure, Compared] = {}
    for structure in sorted(_finalists(_with_criteria(first.values())), key=lambda s: s.order):
        begins = [first[structure].trained.fit]
        smaller = done.get(replace(structure, order=structure.order - 1))
        if smaller is not None:
            begins += [moved_to(structure, smaller.trained, factor=(1.0, -pole))
                       for pole in (0.3, 0.85)]
        trained = fitted(train, structure, *begins, steps=FIRST_STEPS)
        done[structure] = compared(trained, fitted(samples, structure, trained.fit))
    finished = {one.structure: one for one in _with_criteria(done.values())}
    return [finished.get(structure, one) for structure, one in first.items()]


def _with_criteria(compared: Iterable[Compared]) -> list[Compared]:
    """The same with their criteria, and no error less than what a simulation rounds."""
    compared = list(compared)
    best = min(one.whole for one in compared)
    count, rows = len(best.left), effective(best.left)
    # A step of the recursion A y = ... rounds by |A|_1 |y| eps at most, and 1/A hands that on.
    answer = lfilter([1.0], best.denominator, np.eye(1, len(best.problem.v))[0])
    rounded = 2.0 * float(np.finfo(float).eps) * float(np.sqrt(np.mean(best.problem.y**2))) \
        * float(np.abs(best.denominator).sum() * np.linalg.norm(answer))
    return [one._replace(
        held_out=max(one.held_out, rounded),
        criterion=rows * log(max(one.whole.squares, rounded**2 * count, TINY))
        + one.structure.unknowns * log(max(rows, 1.0)),
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
    eligible = _eligible(compared)
    needed = [one for one in eligible if not gives_way(one.whole, eligible)]
    least = min(needed, key=lambda one: one.held_out)
    within = least.held_out * max(1.05, 1.0 + least.scatter)
    return min((one for one in needed if one.held_out <= within), key=lambda one: one.criterion)


def _eligible(compared: Sequence[Compared]) -> list[Compared]:
    """Structures that were fitted to the end, without those that are no model if there are others.
    """
    found = [one for one in compared if np.isfinite(one.criterion)]
    for useless in (_explains_nothing, _rings):
        found = [one for one in found if not useless(one.whole)] or found
    return found


def _explains_nothing(found: Model) -> bool:
    """Whether it leaves more than there is of y, however well its last part is predicted anew."""
    return found.squares > float(np.sum(found.problem.y**2))


def _rings(found: Model) -> bool:
    """Whether an oscillation hardly dies out over the record: it explains what G does not."""
    lasting = 4.0  # time constants that a record has to be long
    poles = np.roots(np.append(1.0, found.a))
    return bool(np.any((poles.imag != 0.0) & (abs(poles) > 1.0 - lasting / len(found.problem.v))))


def gives_way(found: Model, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole, and the structure without that pole is compared as well."""
    s = found.structure
    smaller = [Structure(s.order - 1, s.delay, s.integrator and pole != 1.0)
               for pole in cancelled_poles(found)]
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
    return [complex(pole) for pole in poles if
            float(np.abs(zeros - pole).min(initial=inf)) < 0.02 * max(abs(1.0 - pole), 0.01)]


def equal_delays(compared: Sequence[Compared], chosen: Compared) -> list[int]:
    """Delays that explain y as well as the chosen one, with as many poles or more, for a lag that
    a pole of its own would make may stand for a delay."""
    taken = chosen.structure
    return sorted({
        one.structure.delay for one in compared
        if one.structure.integrator == taken.integrator and one.structure.order >= taken.order
        and one.criterion <= chosen.criterion + PLATEAU})


def _predicted(found: Model, later: Samples) -> Array:
    """Simulation over samples (M,), begun in the state and with the offset that fit them best."""
    begin = replace(found.fit, x=np.zeros(1), p0=float(found.run.p[-1]))
    problem = later.problem(found.structure)
    return problem.at(problem.begun(begin, True)).y


def later(early: StructureSearch, options: Options, progress: Progress) -> StructureSearch:
    """The search among later delays, where one of them explains y as well or better: the same
    structure is fitted with one sample of delay more and more, from the fit before."""
    worse_for = 3  # delays in a row that fit worse, behind which no later one is tried
    alike_by = 5.0  # log-likelihood by which a delay that fits alike may be worse
    best, latest = early.best, min(LONGEST_DELAY, len(early.samples.v) // 20)
    progress('searching later delays')
    samples = replace(early.samples, first=latest + 1)
    scan = [fitted(samples, best.structure, best.fit)]
    alike, rows = list(scan), effective(scan[0].left)
    while scan[-1].structure.delay < min(latest, alike[-1].structure.delay + worse_for):
        before = scan[-1]
        structure = replace(best.structure, delay=before.structure.delay + 1)
        anew = first_model(samples, structure, before.gap, before.fit.p0, (0.6,))
        scan.append(fitted(samples, structure, moved_to(structure, before), anew.fit,
                           steps=FIRST_STEPS))
        most = min(one.squares for one in scan) * exp(2.0 * alike_by / rows)
        alike = [one for one in scan if one.squares <= most]
    first, last = (alike[k].structure.delay for k in (0, -1))
    if last <= EARLY[-1]:
        return early
    early = early._replace(apart=max(early.apart, by_model(best.gap, [
        (one.gap, one.behind(scan[0], rows)) for one in alike])))
    # What no G with a backlash explains, any delay explains a little better.
    if what_it_is(observed_of(early.samples, best, Units())):
        return early
    # Poles may stand for a part of a delay: where many fit alike, it is one of the last.
    late = searched(early.samples.v, early.samples.y, options, range(
        max(first - 1, last - 5, 0), min(last + 2, latest) + 1), progress)
    rows = effective(late.best.left)
    better = rows * log(max(best.rms, TINY) / max(late.best.rms, TINY)) + 0.5 * log(rows) * (
        best.structure.unknowns - late.best.structure.unknowns)
    # Very strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773-795).
    return late if late.best.structure.delay < max(late.delays) and better > 5.0 else early


def observed_of(samples: Samples, best: Model, units: Units) -> Observed:
    """The signals of a fit; v at the same samples as y."""
    v0, v_size, y0, y_size = units
    known, y = best.problem.known, samples.fitted_y
    noise = max(noise_of(np.flatnonzero(known).astype(float), y[known]), quantum(y) / sqrt(12.0))
    return Observed(v0 + v_size * samples.v[samples.first:samples.last], y0 + y_size * y,
                    v0 + v_size * best.run.p, y0 + y_size * best.run.y, y_size * noise,
                    v_size * best.gap)
