"""Which order, delay and integrator G has: a search of the gap, and a race of structures.

    the gap with a general G  ->  orders, delays, integrators on held-out samples
    ->  the gap again with the one that is taken  ->  later delays, where these fit as well
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import exp, inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS
from backlash_ros.core.estimation.posterior import step_of
from backlash_ros.core.estimation.search import search
from backlash_ros.core.estimation.settings import ROWS
from backlash_ros.core.identification.deviations import by_model, effective
from backlash_ros.core.identification.not_play import Observed, what_it_is
from backlash_ros.core.identification.order_selection import (
    Compared,
    compare,
    eligible,
    gives_way,
    predicted,
    selected,
)
from backlash_ros.core.identification.result import HeldOut, Options
from backlash_ros.core.identification.structure import (
    TINY,
    Model,
    Samples,
    Structure,
    first_model,
    fitted,
    moved_to,
)
from backlash_ros.core.identification.verdict import ANOTHER
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.samples import noise_of, outliers

Array = NDArray[np.float64]
Progress = Callable[[str], object]

POLES = 3  # of the general G with which the gap is searched first; it has a tap for each delay
EARLY, LONGEST_DELAY = (0, 1, 2, 3), 40  # delays that are compared first, and the longest
ALIKE = 5.0  # log-likelihood by which a delay that fits alike may be worse
SMALLEST_GAP = 2e-3  # that is searched for, over the swing of v


class Units(NamedTuple):
    """Middle and size of v and of y, by which both are centred and scaled."""

    v: float = 0.0
    v_size: float = 1.0
    y: float = 0.0
    y_size: float = 1.0


class StructureSearch(NamedTuple):
    """The best of the structures that were compared, in scaled units.

    rivals: other minima (gap, how far behind). profile: gaps, and their rms. apart: deviation of
    the gap beside the fit's, by a model or a delay that fits alike.
    """

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Model
    rivals: list[tuple[float, float]]
    profile: tuple[Array, Array]
    held_out: HeldOut
    delays: Sequence[int]
    apart: float = 0.0


def searched(
    v: Array, y: Array, options: Options, delays: Sequence[int], progress: Progress,
    step: float | None = None,
) -> StructureSearch:
    """The best structure with one of these delays. step: of the readings, None: told from them."""
    far_off = 0.03  # relative distance of the last gap from the first, with which to begin anew
    progress('searching the gap')
    samples = Samples(v, y, max(delays) + 1, len(v), step_of(y) if step is None else step)
    cut = samples.last - round(options.held_out * samples.count)
    found = _with_general(samples, delays)
    kept = without_outliers(samples, found[0])
    if kept is not samples:
        samples = kept
        found = _with_general(samples, delays)
    candidates = found[:2]
    structures = [
        Structure(order, delay, integrator) for integrator in options.integrators
        for delay in delays for order in options.orders if order >= integrator
    ]
    for again in (True, False):
        progress('comparing orders and delays')
        compared = compare(samples, candidates, structures, cut)
        progress('refining')
        for _ in structures:
            chosen = selected(compared)
            models, profile = _of_gaps(samples, chosen.whole)
            best = models[0]
            if not gives_way(best, eligible(compared)):
                break
            # Only the best fit of all shows that a pole is none.
            compared = [one._replace(whole=best) if one is chosen else one for one in compared]
        if not again or abs(best.gap - candidates[0].gap) <= far_off * best.gap:
            break
        candidates = [best, candidates[0]]  # the general G may have been a poor one
    if best.rms > samples.step > 0.0:  # rounding is the least of what is left
        return searched(v, y, options, delays, progress, 0.0)
    rows = effective(best.left)
    rivals = sorted(
        (0.5 * rows * log(max(one.squares, TINY) / max(best.squares, TINY)), one.gap)
        for one in models if abs(one.gap - best.gap) > ANOTHER * best.gap
    )
    held_out = HeldOut(
        cut, samples.y[cut:samples.last], predicted(chosen.trained, replace(samples, first=cut)),
        chosen.held_out, chosen.trained.rms)
    return StructureSearch(
        samples, compared, chosen, best, [(gap, behind) for behind, gap in rivals],
        (profile[0], best.rms * profile[1]), held_out, delays, by_model(best.gap, [
            (one.whole.gap, one.criterion - chosen.criterion) for one in compared]))


def _with_general(samples: Samples, delays: Sequence[int]) -> list[Model]:
    """Models of different gaps, the best first, with a few poles and a tap for each delay."""
    general = Structure(POLES, min(delays), False, POLES + max(delays) - min(delays))
    swing = float(np.ptp(samples.v))
    begins = sorted((
        first_model(samples, general, gap, float(samples.v[0]) + 0.5 * gap)
        for gap in (0.0, 0.05 * swing, 0.2 * swing, 0.5 * swing)
    ), key=lambda one: one.squares)
    rough = [fitted(samples, general, one.fit, FEW_STEPS) for one in begins[:2]]
    best = min(rough, key=lambda one: one.squares)
    for _ in range(2):
        models, _ = _of_gaps(samples, best)
        if models[0].squares > 0.9 * best.squares:
            break
        best = models[0]
    return models


def _of_gaps(samples: Samples, like: Model) -> tuple[list[Model], tuple[Array, Array]]:
    """Fits of the same structure to the minima over the gap, the best first; the profile."""
    most, apart = 4, 0.005  # minima that are fitted, and the relative distance of different ones
    structure, problem = like.structure, like.problem
    y = np.where(problem.known, problem.y, nan)
    swing = float(np.ptp(problem.v))
    hypotheses, _ = search(structure, problem.v, y, 1e-12, 0.98 * swing,
                           like.fit.theta[3:], SMALLEST_GAP)
    begins, gaps = [like.fit], [like.gap]
    for _, gap, p0, _ in hypotheses:
        if len(begins) <= most and all(abs(gap - other) > ANOTHER * other for other in gaps):
            gaps.append(gap)
            begins.append(problem.step(moved_to(structure, like, gap, p0), held=True))
    some = sorted((fitted(samples, structure, begin, FIRST_STEPS) for begin in begins),
                  key=lambda one: one.squares)
    models: list[Model] = []
    for one in some:
        model = one if one.squares > 1.5 * some[0].squares else fitted(samples, structure, one.fit)
        if all(abs(model.gap - other.gap) > apart * other.gap for other in models):
            models.append(model)
    models.sort(key=lambda one: one.squares)
    by_gap: dict[float, float] = {}
    for h in hypotheses:
        by_gap[h.gap] = max(h.evidence, by_gap.get(h.gap, -inf))
    curve = np.array(sorted(by_gap.items())).reshape(-1, 2)
    behind = curve[:, 1].max(initial=-inf) - curve[:, 1]
    return models, (curve[:, 0], np.exp(behind / min(len(problem.v), ROWS)))


def without_outliers(samples: Samples, found: Model) -> Samples:
    """The same without readings that are none, by more than rounding: far off, or repeated."""
    y = samples.fitted_y()
    step = quantum(y)
    same = np.append(False, np.diff(y) == 0.0)
    alone = same & ~np.append(False, same[:-1]) & ~np.append(same[1:], False)
    moves = np.abs(np.diff(found.simulated, prepend=found.simulated[0]))
    wild = outliers(found.residual, step) | alone & (moves > max(step, 0.5 * found.rms))
    if not wild.any():
        return samples
    y = samples.y.copy()
    y[samples.first:samples.last][wild] = nan
    return replace(samples, y=y)


def later(early: StructureSearch, options: Options, progress: Progress) -> StructureSearch:
    """The search among later delays, where one of them explains y as well or better.

    The same structure is fitted with one sample of delay more and more, from the fit before.
    """
    worse_for = 3  # delays in a row that fit worse, behind which no later one is tried
    progress('searching later delays')
    best, latest = early.best, min(LONGEST_DELAY, len(early.samples.v) // 20)
    samples = replace(early.samples, first=latest + 1)
    scan = [fitted(samples, best.structure, best.fit)]
    alike, rows = list(scan), effective(scan[0].left)
    while scan[-1].structure.delay < min(latest, alike[-1].structure.delay + worse_for):
        before = scan[-1]
        structure = replace(best.structure, delay=before.structure.delay + 1)
        begins = [moved_to(structure, before), first_model(
            samples, structure, before.gap, before.fit.p0, (0.6,)).fit]
        scan.append(min((fitted(samples, structure, begin, FIRST_STEPS) for begin in begins),
                        key=lambda one: one.squares))
        most = min(one.squares for one in scan) * exp(2.0 * ALIKE / rows)
        alike = [one for one in scan if one.squares <= most]
    first, last = (alike[k].structure.delay for k in (0, -1))
    if last <= EARLY[-1]:
        return early
    early = early._replace(apart=max(early.apart, by_model(best.gap, [
        (one.gap, rows * log(max(one.squares, TINY) / max(scan[0].squares, TINY)))
        for one in alike])))
    # What no G with a backlash explains, any delay explains a little better.
    other = what_it_is(observed_of(early.samples, best, Units()))
    if other is not None and not other.known:
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
    problem = best.problem
    y = np.where(problem.known, problem.y, nan)
    noise = noise_of(np.flatnonzero(problem.known).astype(float), y[problem.known])
    noise = max(noise, quantum(y) / sqrt(12.0))
    v = samples.v[samples.first:samples.last]
    return Observed(v0 + v_size * v, y0 + y_size * y, v0 + v_size * best.p,
                    y0 + y_size * best.simulated, y_size * noise, v_size * best.gap)
