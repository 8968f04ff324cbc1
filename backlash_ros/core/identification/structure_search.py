"""Choose the order and delay of G, and whether it integrates, by comparing structures.

    search the gap with a general G  ->  compare orders, delays, integrators on held-out samples
    ->  search the gap again with the chosen one  ->  try later delays if the latest fits as well

A structure with a pole that a zero cancels gives way to the same one without that pole. Structures
whose held-out error is within 5 % or one standard deviation of the least predict equally well; the
one with the least BIC over all samples, N' log(squares) + unknowns log(N'), is chosen from them,
with N' = N (1 - r) / (1 + r) for the lag-1 correlation r. Residuals that repeat count once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS
from backlash_ros.core.estimation.search import search
from backlash_ros.core.estimation.settings import AS_GOOD
from backlash_ros.core.identification.model import Model, Samples, Structure, first_model, fitted
from backlash_ros.core.judgement.deviations import by_model, effective
from backlash_ros.core.judgement.not_play import Observed, best_other
from backlash_ros.core.judgement.verdict import ANOTHER
from backlash_ros.core.plant.quantized import step_of
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records.readings import noise_of, outliers, quantum

Progress = Callable[[str], object]
EARLY, LONGEST_DELAY = (0, 1, 2, 3), 40  # delays that are compared first, and the longest of all
GENERAL_POLES = 3  # of the G for the first search of the gap; it has a tap for each delay
HELD_OUT = 1.0 / 3.0  # share of the record that is held out, at its end
ALIKE = 0.1  # gain of the log-likelihood that is not worth another step
HOPELESS = 1.5  # ratio of squares to the least beyond which a fit is abandoned
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good
EXACT = 1e-10  # rms error, over the rms of y, below which all is rounding


@dataclass(frozen=True)
class Options:
    """What to compare. delays [samples]: if empty, EARLY and then later ones while they fit better.
    integrators: whether G has one. slope: the given m, inseparable from the gain of G."""

    orders: Sequence[int] = (0, 1, 2, 3, 4)
    delays: Sequence[int] = ()
    integrators: Sequence[bool] = (False, True)
    slope: float = 1.0


class Compared(NamedTuple):
    """A structure and its fits. trained: to the first part; held_out: its rms error on the last
    part; scatter: relative standard deviation of that. whole: fit to all samples. criterion: its
    BIC, the smaller the better."""

    structure: Structure
    held_out: float
    trained: Model
    whole: Model
    criterion: float = inf
    scatter: float = 0.0


class HeldOut(NamedTuple):
    """Prediction of the samples (M,) held out, from index `first` on. rms: of its error; trained:
    rms error of the fit to the samples before. All in units of the record."""

    first: int
    measured: Array
    simulated: Array
    rms: float
    trained: float


class StructureSearch(NamedTuple):
    """The best of the structures compared, in scaled units. rivals: other minima, as (gap, loss of
    log-likelihood). apart: standard deviation of the gap over models or delays that fit alike."""

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Model
    rivals: list[tuple[float, float]]
    held_out: HeldOut
    delays: Sequence[int]
    apart: float


def searched(
    record: Samples, options: Options, delays: Sequence[int], progress: Progress,
) -> StructureSearch:
    """Find the best structure with one of these delays for the whole record."""
    progress('searching the gap')
    units, samples = record.units, replace(record, first=max(delays) + 1, last=len(record.v))
    (found, fewer), drifting = _with_general(samples, delays), replace(samples, drifts=True)
    if not samples.drifts:
        drifts, with_fewer = _with_general(drifting, delays)
        # One pole more, close to 1, may stand in for a drift.
        stands_in = with_fewer.rms < AS_GOOD * found[0].rms < fewer.rms
        if found[0].rms > AS_GOOD * drifts[0].rms or stands_in:
            samples, found = drifting, drifts
    kept = cleaned(samples, found[0])
    if kept.y is not samples.y or kept.step != samples.step:
        samples, found = kept, sorted(fitted(kept, one.structure, one.fit) for one in found)
    cut = samples.last - round(HELD_OUT * len(samples.fitted_y))
    structures = [
        Structure(order, delay, integrator) for integrator in options.integrators
        for delay in delays for order in options.orders if order >= integrator]
    progress('comparing orders and delays')
    likely = [one for one in found[:2] if one.squares <= HOPELESS * found[0].squares]
    compared = _compare(samples, likely, structures, cut)
    progress('refining')
    for _ in structures:
        chosen = selected(compared)
        models = _of_gaps(samples, chosen.whole)
        best = models[0]
        worse = _is_no_plant(best) and not _is_no_plant(chosen.whole)
        if not (worse or gives_way(best, _eligible(compared))):
            break
        # Only the best fit of a structure shows what it is.
        compared = [one._replace(whole=best) if one is chosen else one for one in compared]
    rows = effective(best.left)
    rivals = [(one.gap, 0.5 * one.behind(best, rows)) for one in models
              if abs(one.gap - best.gap) > ANOTHER * best.gap]
    later = replace(samples, first=cut)
    measured, simulated = (units.y + units.y_size * y for y in (
        later.fitted_y, _predicted(chosen.trained, later)))
    held_out = HeldOut(cut, measured, simulated, units.y_size * chosen.held_out,
                       units.y_size * chosen.trained.rms)
    return StructureSearch(
        samples, compared, chosen, best, rivals, held_out, delays, by_model(best.gap, [
            (one.whole.gap, one.criterion - chosen.criterion) for one in _eligible(compared)]))


def _with_general(samples: Samples, delays: Sequence[int]) -> tuple[list[Model], Model]:
    """Models of different gaps with a general G, the best first, and one with a pole less."""
    # One pole after the other, as several at once often end up close to 1, with a wrong gap.
    first, *others = (Structure(poles, min(delays), False, poles + max(delays) - min(delays))
                      for poles in range(GENERAL_POLES + 1))
    begins = sorted(first_model(samples, first, gap, float(samples.v[0]) + 0.5 * gap)
                    for gap in (np.ptp(samples.v) * np.array([0.0, 0.05, 0.2, 0.5])).tolist())
    best = fitted(samples, first, *(one.fit for one in begins[:2]), steps=FEW_STEPS)
    for general in others:
        fewer, anew = best, first_model(samples, general, best.gap, best.fit.p0).fit
        best = fitted(samples, general, anew, best.begin_with_pole(0.6, general), steps=FEW_STEPS)
    models = _of_gaps(samples, best)
    # Linearised around a better G, the search may find another gap.
    better = models[0].squares < 0.9 * best.squares
    return (_of_gaps(samples, models[0]) if better else models), fewer


def _of_gaps(samples: Samples, like: Model) -> list[Model]:
    """Fits of the structure of `like` from each local minimum over the gap, the best first."""
    most, apart = 4, 0.005  # minima that are fitted; relative distance of gaps that differ
    smallest = 2e-3  # least gap that is searched for, over the swing of v
    structure, problem = like.structure, like.problem
    y = np.where(problem.known, problem.y, nan)
    hypotheses, _ = search(structure, problem.v, y, 1e-12, 0.98 * float(np.ptp(problem.v)),
                           like.fit.theta[3:], smallest=smallest)
    begins, gaps = [like.fit], [like.gap]
    for h in hypotheses:
        if len(begins) <= most and all(abs(h.gap - other) > ANOTHER * other for other in gaps):
            gaps.append(h.gap)
            begins.append(problem.step(like.begin(h.gap, h.p0), held=True))
    some = sorted(fitted(samples, structure, begin, steps=FIRST_STEPS) for begin in begins)
    models: list[Model] = []
    for one in some:
        hopeless = one.squares > HOPELESS * some[0].squares
        model = one if hopeless else fitted(samples, structure, one.fit)
        if all(abs(model.gap - other.gap) > apart * other.gap for other in models):
            models.append(model)
    return sorted(models)


def cleaned(samples: Samples, found: Model) -> Samples:
    """The samples without outliers, and without readings repeated once although the model moves;
    with the quantization step, unless the residual exceeds it: then rounding does not dominate."""
    y, simulated, step_of_y = samples.fitted_y, found.run.y, step_of(samples.y)
    step = quantum(y)
    same = np.append(False, np.diff(y) == 0.0)
    alone = same & ~np.append(False, same[:-1]) & ~np.append(same[1:], False)
    moves = np.abs(np.diff(simulated, prepend=simulated[0]))
    wild = outliers(y - simulated, step) | alone & (moves > max(step, 0.5 * found.rms))
    samples = replace(samples, step=step_of_y * (found.rms <= step_of_y))
    if not wild.any():
        return samples
    y = samples.y.copy()
    y[samples.first:samples.last][wild] = nan
    return replace(samples, y=y)


def _compare(
    samples: Samples, candidates: Sequence[Model], structures: Sequence[Structure], cut: int,
) -> list[Compared]:
    """Fit each structure to the samples before `cut` and to all of them, beginning with the gap and
    p0 of the candidates, which are about right, and with the fit of one pole less."""
    train, later = replace(samples, last=cut), replace(samples, first=cut)
    found: dict[Structure, tuple[Model, Model]] = {}
    for structure in sorted(structures, key=lambda s: s.order):
        begin = min(first_model(train, structure, like.gap, like.fit.p0) for like in candidates)
        smaller = found.get(replace(structure, order=structure.order - 1))
        also = [smaller[0].begin_with_pole(0.6, structure)] if smaller else []
        trained = fitted(train, structure, begin.fit, *also, steps=FIRST_STEPS, least_gain=ALIKE)
        found[structure] = trained, fitted(
            samples, structure, trained.fit, steps=FIRST_STEPS, least_gain=ALIKE)
    best = min(whole for _, whole in found.values())
    weights = best.run.weights[best.problem.known]  # readings that repeat an error count once
    rows, exact = float(weights.mean()) * effective(best.left), EXACT**2 * len(weights)
    compared = []
    for structure, (trained, whole) in found.items():
        if whole.squares <= HOPELESS * best.squares:
            whole = fitted(samples, structure, whole.fit, least_gain=ALIKE)
        error = later.fitted_y - _predicted(trained, later)
        error = error[np.isfinite(later.fitted_y)]
        rms = float(np.sqrt(np.mean(error**2)))
        compared.append(Compared(
            structure, max(rms, EXACT) if np.isfinite(rms) else inf, trained, whole,
            rows * log(max(float(weights @ whole.left**2), exact))
            + structure.unknowns * log(max(rows, 1.0)), 1.0 / sqrt(2.0 * effective(error))))
    return compared


def predictors(compared: Sequence[Compared]) -> list[Compared]:
    """The structures that predict the held-out samples about as well as the best of them."""
    eligible = _eligible(compared)
    needed = [one for one in eligible if not gives_way(one.whole, eligible)]
    least = min(needed, key=lambda one: one.held_out)
    within = least.held_out * max(1.05, 1.0 + least.scatter)
    return [one for one in needed if one.held_out <= within]


def selected(compared: Sequence[Compared]) -> Compared:
    """The structure to choose: of the good predictors, the one with the least criterion."""
    return min(predictors(compared), key=lambda one: one.criterion)


def _eligible(compared: Sequence[Compared]) -> list[Compared]:
    """Leave out structures that explain nothing or are no plant, unless all of them do or are."""
    found = list(compared)
    for useless in (_explains_nothing, _is_no_plant):
        found = [one for one in found if not useless(one.whole)] or found
    return found


def _explains_nothing(found: Model) -> bool:
    """Whether the residual exceeds y, though the last part, begun anew, may be predicted well."""
    return found.squares > float(np.sum(found.problem.y**2))


def _is_no_plant(found: Model) -> bool:
    """Whether an oscillation hardly decays over the record, a negative real pole stands in for half
    a sample less of delay, or an integrator moves y by so little that it stands in for a drift."""
    # Least length of the record, in time constants of the oscillation; least share of y.
    lasting, least = 4.0, 0.1
    poles, gain = np.roots(np.append(1.0, found.a)), found.numerator.sum() / (1.0 + found.a.sum())
    most = np.where(poles.imag != 0.0, 1.0 - lasting / len(found.problem.v), poles.real)
    drifts = found.structure.integrator and \
        abs(gain) * np.cumsum(found.run.u).std() < least * found.run.y.std()
    return bool(np.any(abs(poles) > most) or drifts)


def gives_way(found: Model, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole and the structure without that pole was compared as well."""
    s = found.structure
    smaller = [Structure(s.order - 1, s.delay, s.integrator and pole != 1.0)
               for pole in cancelled_poles(found)]
    # A smaller structure that explains far less was fitted badly.
    return any(one.structure in smaller and one.whole.squares <= 2.0 * found.squares
               for one in compared)


@lru_cache(64)  # about one for each structure compared
def cancelled_poles(found: Model) -> list[complex]:
    """Poles that a zero all but cancels; the pole of an integrator is exactly 1."""
    if not np.isfinite(found.numerator).all():
        return []
    zeros = np.roots(found.numerator)
    poles = [*np.roots(np.append(1.0, found.a)), *[1.0] * found.structure.integrator]
    # Within 2 % of the distance of the pole from 1; a zero at 1 cancels an integrator.
    return [complex(pole) for pole in poles if
            float(np.abs(zeros - pole).min(initial=inf)) < 0.02 * max(abs(1.0 - pole), 0.01)]


def equal_delays(compared: Sequence[Compared], chosen: Compared) -> list[int]:
    """Delays that explain y as well as the chosen one, with at least as many poles: the lag of an
    additional pole may stand in for part of a delay."""
    taken = chosen.structure
    return sorted({
        one.structure.delay for one in compared
        if one.structure.integrator == taken.integrator and one.structure.order >= taken.order
        and one.criterion <= chosen.criterion + PLATEAU})


def _predicted(found: Model, later: Samples) -> Array:
    """Simulated y (M,) over later samples, from the initial state and offset that fit them best."""
    begin = replace(found.fit, x=np.zeros(1), p0=float(found.run.p[-1]))
    problem = later.problem(found.structure)
    return problem.at(problem.begun(begin, True)).y


def later(early: StructureSearch, options: Options, progress: Progress) -> StructureSearch:
    """Extend the search to later delays while the latest explains y as well as the chosen one."""
    latest = min(LONGEST_DELAY, len(early.samples.v) // 20)
    while (last := max(early.delays)) < latest and last in equal_delays(
            early.compared, early.chosen):
        # If it is no play, every later delay fits a little better. Tests of the residual are left
        # out here: they would take too short a delay for something that moves y besides v.
        o = observed_of(samples := early.samples, early.best)
        if o.unexplained and best_other(o):
            break
        progress('searching later delays')
        at = _likeliest_delay(samples, early.best, range(last, latest + 1))
        late = searched(
            samples, options, range(max(at - 2, last), min(at + 2, latest) + 1), progress)
        rows, best = effective(late.best.left), early.best
        better = rows * log(max(best.rms, EXACT) / max(late.best.rms, EXACT)) + 0.5 * log(rows) * (
            best.structure.unknowns - late.best.structure.unknowns)
        # Very strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773-795).
        if better <= 5.0 or (_is_no_plant(late.best) and not _is_no_plant(best)):
            return early._replace(delays=[*early.delays, *late.delays], apart=max(
                early.apart, by_model(best.gap, [(late.best.gap, -2.0 * better)])))
        early = late
    return early


def _likeliest_delay(samples: Samples, like: Model, delays: range) -> int:
    """The delay with which the structure of `like` leaves the smallest residual."""
    samples, begin, squares = replace(samples, first=delays[-1] + 1), like.begin(), []
    for delay in delays:
        found = fitted(samples, replace(like.structure, delay=delay), begin, steps=FEW_STEPS)
        begin = found.begin()
        squares.append(found.squares)
    return delays[int(np.argmin(squares))]


def observed_of(samples: Samples, best: Model) -> Observed:
    """The signals of a fit in units of the record, with v at the samples of y, not delayed."""
    v0, v_size, y0, y_size = samples.units
    known, y = best.problem.known, samples.fitted_y
    noise = max(noise_of(np.flatnonzero(known).astype(float), y[known]), quantum(y) / sqrt(12.0))
    return Observed(v0 + v_size * samples.v[samples.first:samples.last], y0 + y_size * y,
                    v0 + v_size * best.run.p, y0 + y_size * best.run.y, y_size * noise,
                    v_size * best.gap)
