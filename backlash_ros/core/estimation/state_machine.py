"""Updates what is believed of the backlash with a record of samples: a pure function.

| state     | meaning                    | published            | left for, when                  |
|-----------|----------------------------|----------------------|---------------------------------|
| SEARCHING | no fit explains the record | first guess, or what | KNOWN: two fits in a row are    |
|           |                            | was known before     | known well enough and agree     |
| KNOWN     | the fit explains all       | the fit              | DOUBTED: newer samples          |
|           | samples                    |                      | contradict it                   |
| DOUBTED   | newer samples contradict   | the fit before them  | KNOWN: it predicts again, or    |
|           | the fit                    |                      | another backlash explains them; |
|           |                            |                      | SEARCHING: neither happens soon |
|           |                            |                      | enough                          |
"""

from dataclasses import replace
from math import isnan, log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.belief import Belief, Known, State, Trial, shortened
from backlash_ros.core.estimation.explanations import Setup, afresh, mixed
from backlash_ros.core.estimation.fit import FEW_STEPS, Problem
from backlash_ros.core.estimation.late_commands import likelier, weighed
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.estimation.settings import BLOCKS, FEWEST, MISFIT, PREDICTED, SHORT_RECORD
from backlash_ros.core.estimation.unmodelled import as_known, coasts, with_walk
from backlash_ros.core.plant.backlash import gap_variance
from backlash_ros.core.plant.numerics import agree, chance_limit, isolated, log_density, squares_of
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window


def learn(setup: Setup, record: Window, before: Belief) -> Belief:
    """Update the belief with a record that begins at sample `before.kept.first`.

    If the numerics fail, the search starts anew with the newest samples; nothing is raised.
    """
    look = {State.SEARCHING: _searching, State.KNOWN: _known, State.DOUBTED: _doubted}
    kept, record = before.kept, record.without(before.kept.rejected)
    try:
        if before.fit is not None and record.is_open:  # late commands are no contradiction
            since = before.end - setup.family.memory if record.end < before.thorough[0] else 0
            record, swapped = likelier(setup, record, before.fit, kept.swapped, kept.older, since)
            before = before._replace(kept=kept._replace(swapped=swapped))
        after = look[before.state](setup, record, before)
        return after._replace(holds=_holds(setup, record, after))
    except (np.linalg.LinAlgError, ArithmeticError):
        first = max(record.end - settings.FIRST_FIT, record.first)
        return _begun_anew(before, first, record.end, record.end + FEWEST)


def _holds(setup: Setup, record: Window, after: Belief) -> bool:
    """Whether what is published leaves next to nothing of what contradicts the fit."""
    fit, known = after.fit or after.found, after.published
    if after.reason is not Status.INCONSISTENT or after.coasts or not known:
        return False
    if not fit:
        return after.holds  # as before, until there is one again
    problem = setup.problem(record.between(after.kept.first))
    there = as_known(problem, known.crossings, replace(fit, knots=np.zeros(0)))
    newest = problem.at(there).error[max((after.doubt_from or 0) - after.kept.first, 0):]
    moves = float(np.mean(newest**2)) ** 0.5 / there.left.gain
    return moves < settings.NEGLIGIBLE * there.m * there.gap and setup.family.count > 0


def _begun_anew(before: Belief, first: int, end: int, next_at: int) -> Belief:
    """Drop the fit and all samples before `first`; what was published stays."""
    return before._replace(
        reason=before.reason if before.fit is None else Status.INCONSISTENT, fit=None, found=None,
        doubt_from=None, end=end, next_at=next_at,
        kept=before.kept._replace(first=first, older=None))


def _searching(setup: Setup, record: Window, before: Belief) -> Belief:
    count, tried = len(record.v), before.found
    soon = record.end + max(count // BLOCKS, FEWEST)
    known_once = tried is not None and setup.is_known(tried)
    if tried is not None and not known_once and record.end < before.thorough[0] \
            and not setup.is_known(tried, record.turns(max(tried.gap, 0.0), tried.p0)):
        return before._replace(end=record.end, next_at=soon)
    # If many reversals of the widest gap that it leaves open did not suffice, wait for more.
    many = tried is not None and tried.valid and record.turns(
        tried.gap + settings.BY_CHANCE * tried.gap_std, tried.p0) >= settings.HELD_REVERSALS
    growth = 2.0 if many else settings.GROWTH
    search_at = record.end + max(int(count * (growth - 1.0)), FEWEST)
    fit, shorter = afresh(setup, record, also=tried, walks=True), record
    why = _why(setup, fit, record, before)
    part, found, swapped = _with_commands(setup, record, fit, before.kept.swapped)
    while why in (Status.INCONSISTENT, Status.NOT_EXCITED) and len(shorter.v) >= 150:
        # An early event may have spoilt the record: try its newest third, down to 50 samples.
        shorter = shorter.between(shorter.end - len(shorter.v) // 3)
        newest = _with_commands(setup, shorter, afresh(setup, shorter), before.kept.swapped)
        if newest[1] is not None and setup.is_known(newest[1]):
            part, found, swapped = newest
            break
    after = before._replace(end=record.end, next_at=search_at, thorough=(search_at, 0.0),
                            found=None, reason=why, coasts=False)
    if found is None:
        return after
    if coasts(setup.problem(part), found, before.published and before.published.crossings):
        after = after._replace(coasts=True, reason=Status.INCONSISTENT)
    after = after._replace(kept=before.kept._replace(swapped=swapped), found=found)
    if not setup.is_known(found):
        # Look again soon if nothing but another reversal is missing.
        return after._replace(next_at=soon) if setup.is_known(found, settings.REVERSALS) else after
    if tried is None or not known_once or not tried.alike(found):
        # A first estimate must be found twice in a row: a few samples alone may mislead.
        return after._replace(next_at=soon)
    # A fit that leaves more than noise must first predict a quarter as many new samples.
    more = len(part.v) // 4 if found.systematic or setup.noisier(found) else 0
    trial = before.trial._replace(must=max(before.trial.must, more))
    return _adopted(setup, part, found, None, after._replace(trial=trial))


def _with_commands(
    setup: Setup, record: Window, found: WindowFit | None, swapped: frozenset[int],
) -> tuple[Window, WindowFit | None, frozenset[int]]:
    """Alternate between late commands and the fit until both are consistent."""
    if found is None or not record.is_open:
        return record, found, swapped
    sent = record, found, swapped
    for _ in range(4):
        record, now = likelier(setup, record, found, swapped, None)
        if now == swapped:
            break
        swapped, found = now, afresh(setup, record, also=found) or found
    # If more than noise remains, late commands explain nothing: keep the record as it was sent.
    noisier = found.systematic and setup.noisier(found)
    return sent if noisier else weighed(setup, record, found, swapped, None)


def _why(setup: Setup, found: WindowFit | None, record: Window, before: Belief) -> Status:
    known = before.published
    if len(record.v) < 100 and before.reason is Status.ACQUIRING:
        return Status.ACQUIRING
    if found is None:
        crosses = known and np.ptp(record.v) > known.crossings[1] - known.crossings[2]
        return Status.INCONSISTENT if crosses else Status.NOT_EXCITED
    # Until v has crossed the gap, a fit may find next to none: use no less than the first guess.
    gap = max(found.gap, setup.guess)
    turns = record.turns(gap, float(record.v[0]))
    large = turns >= settings.HELD_REVERSALS or (
        turns >= setup.turns_needed and found.unexplained * found.gap > settings.NEGLIGIBLE * gap
        and before.found is not None)  # of so few reversals a single fit may miss the optimum
    wrong = setup.moves_against(found) or (large and found.systematic and setup.noisier(found))
    return Status.INCONSISTENT if wrong or (known and setup.is_known(found)) else Status.ACQUIRING


def _adopted(
    setup: Setup, record: Window, fit: WindowFit, older: Prior | None, before: Belief,
) -> Belief:
    count, must = len(record.v), before.trial.must
    another_noise = before.published is None or fit.walk_std > 0.0
    if before.fit is not None and another_noise and fit.alike(before.fit):
        must = min(must, PREDICTED)  # another noise, or a walk, but the same backlash
    return _published(setup, before._replace(
        found=None, doubt_from=None, coasts=coasts(setup.problem(record, older), fit),
        kept=before.kept._replace(first=record.first, older=older), trial=Trial(must, 0, fit.noise),
        next_at=record.end + max(count // BLOCKS, FEWEST),
        thorough=(record.end + count // 4, 0.25 * float(fit.cov[2, 2]))), fit)


def _known(setup: Setup, record: Window, before: Belief) -> Belief:
    held, trial, kept = before.fit, before.trial, before.kept
    assert held is not None
    count, new = len(record.v), before.end - record.first
    problem = setup.problem(record, kept.older)
    fit = problem.fitted(held, FEW_STEPS)
    z = problem.residual(fit)[new:] / held.noise
    wild = _outliers(z)
    if wild.any():
        numbers = frozenset((record.first + new + np.flatnonzero(wild)).tolist())
        cleaned = before._replace(kept=kept._replace(rejected=kept.rejected | numbers))
        return _known(setup, record.without(numbers), cleaned)
    # Samples that the fit does not explain must not move an estimate from before the run.
    rho = held.left.correlation if before.inherited is None else 0.0
    if _contradicts(problem, held, fit, new, rho):
        fit = problem.fitted(held)  # converge before blaming the samples
    lately = trial.predicted < settings.LASTING * trial.must  # it replaced another one lately
    grown = lately and fit.noise > settings.AS_GOOD * trial.noise
    if grown or _contradicts(problem, held, fit, new, rho):
        beyond = np.nan_to_num((problem.residual(held)[new:] / held.noise) ** 2 - MISFIT)
        change = int(np.argmax(np.cumsum(beyond[::-1])[::-1]))
        # Samples that contradict one explanation after another come from no backlash.
        must = min(2 * trial.must, settings.MOST_PREDICTED) if lately else PREDICTED
        return before._replace(end=record.end, found=None, trial=trial._replace(must=must),
                               doubt_from=record.first + new + change, next_at=record.end + FEWEST,
                               reason=Status.INCONSISTENT if lately else before.reason)
    # Look again soon after an early fit: what caused the surprise may have only just begun.
    soon = FEWEST if record.end < before.next_at else max(count // BLOCKS, FEWEST)
    trial = trial._replace(predicted=trial.predicted + count - new)
    after = before._replace(end=record.end, next_at=record.end + soon, trial=trial)
    if record.end >= before.thorough[0] or fit.cov[2, 2] < before.thorough[1]:
        fit = problem.with_intervals(fit)
        if count <= SHORT_RECORD and isnan(problem.older.v):
            other = afresh(setup, record, fit, kept.older, fit)
            found = other and setup.is_known(other, settings.REVERSALS)
            fit = other if other and found else mixed(problem, fit)
            record, fit, swapped = weighed(setup, record, fit, kept.swapped, kept.older)
            problem = setup.problem(record, kept.older)
            after = after._replace(kept=kept._replace(swapped=swapped))
        elif fit.step or fit.spread.any():  # else the posterior is normal
            fit = mixed(problem, fit)
        fit = with_walk(problem, fit, setup.walk_std)
        after = after._replace(thorough=(record.end + 2 * count // 5, 0.25 * float(fit.cov[2, 2])))
    else:
        fit = problem.finished(fit)
    if not fit.alike(held):  # not contradicted, but changed: let the next samples decide
        after = after._replace(trial=Trial(PREDICTED, 0, fit.noise), reason=Status.ACQUIRING)
    after = after._replace(coasts=coasts(problem, fit))
    return _published(setup, *shortened(setup, record, problem, after, fit))


def _contradicts(problem: Problem, held: WindowFit, fit: WindowFit, new: int, rho: float) -> bool:
    """Whether the refit `fit` leaves more than the noise of the held fit: in samples from index
    `new` on, or in all, if it fits those at the cost of others. rho: correlation of residuals."""
    weights = problem.at(fit).weights
    z = problem.residual(fit) / held.noise
    total = float(weights.sum())
    if np.nansum(weights * z**2) > total * chance_limit(settings.AS_GOOD**2, total, rho):
        return True
    weights, z = weights[new:], z[new:]
    count, wild = float(weights.sum()), np.abs(z) > settings.GATE
    mean = float(np.nansum(weights * np.where(wild, 0.0, z**2))) / max(count, 1e-300)
    return mean > chance_limit(MISFIT, count, rho) or bool((wild & ~_outliers(z)).any())


def _outliers(z: Array) -> NDArray[np.bool_]:
    """Which normalized residuals (N,), nan where y was lost, are outliers."""
    return isolated(np.abs(z) > settings.GATE, np.flatnonzero(np.isfinite(z)),
                    settings.OUTLIER_SHARE, settings.OUTLIERS)


def _doubted(setup: Setup, record: Window, before: Belief) -> Belief:
    """Judge the samples since the doubt: it is over, another backlash acts, or neither is clear."""
    held, since, kept = before.fit, before.doubt_from, before.kept
    assert held is not None
    assert since is not None
    count, newer = len(record.v), record.end - since
    after = before._replace(
        end=record.end, found=None, next_at=record.end + max(newer // 4, FEWEST))
    z = setup.problem(record, kept.older).residual(held) / held.noise
    if newer >= 2 * PREDICTED and np.nanmean(z[-PREDICTED:] ** 2) < MISFIT:
        # Whatever it was, it is over: the readings taken meanwhile are discarded.
        lost = kept.rejected | frozenset(range(since, record.end - PREDICTED))
        return after._replace(doubt_from=None, end=record.end - 1, next_at=record.end,
                              kept=kept._replace(rejected=lost))
    if newer >= PREDICTED:
        after = after._replace(reason=Status.INCONSISTENT)
    short = max(SHORT_RECORD, 4 * setup.family.memory)
    explained, whole = settings.AS_GOOD * held.noise, None
    if count <= max(short, 4 * newer) and count < settings.LONGEST:
        whole = afresh(setup, record, older=kept.older, walks=newer >= 2 * PREDICTED)
        if whole is not None and not whole.left.rms < explained:
            whole = None
    for first in (since, (since + record.end) // 2):
        part = record.between(first)
        found = afresh(setup, part, held, held.prior_of_xi) if len(part.v) >= PREDICTED else None
        if found is None or found.left.rms > explained \
                or not setup.is_known(found, found.left.turns + (setup.family.count > 0)):
            continue
        of_two = held.evidence + found.evidence - 0.5 * (4 + len(held.x)) * np.log(len(part.v))
        if whole is not None and whole.evidence > of_two:
            break
        if before.found is None or not before.found.alike(found):
            return after._replace(found=found)
        return _adopted(setup, part, found, held.prior_of_xi, after)
    if whole is not None and setup.is_known(whole):
        return _adopted(setup, record, whole, kept.older, after)
    # Give up after the time that two reversals of the record take on average.
    if newer > max(short, 2 * count // max(held.left.turns, 1)):
        return _begun_anew(after, since, record.end, record.end + 1)
    return after


def _published(setup: Setup, belief: Belief, fit: WindowFit) -> Belief:
    """The belief with a new fit, published if it is known well enough."""
    belief, known = belief._replace(fit=fit), belief.inherited
    if known is not None:
        return _beside_inherited(setup, belief, fit, known)
    if not setup.is_known(fit, settings.REVERSALS if belief.kept.older is not None else None):
        # Newer samples may show that less is known than it seemed: that is no contradiction.
        wrong = not fit.valid or setup.moves_unexplained(fit) or setup.outside_bounds(fit)
        return belief._replace(reason=Status.INCONSISTENT if wrong else Status.ACQUIRING)
    if belief.trial.predicted < belief.trial.must:
        return belief
    cov = fit.crossings_cov + np.diag(setup.drift**2 * (belief.end - belief.kept.first) / 3.0)
    cov[1:, 1:] += (fit.walk_std / fit.m) ** 2 * (belief.next_at - belief.end)
    return belief._replace(
        published=Known(fit.crossings, cov), reason=Status.TRACKING, coasts=False)


def _beside_inherited(setup: Setup, belief: Belief, fit: WindowFit, known: Known) -> Belief:
    # Unexplained motion may be gap as well, and the lost motion of a gear varies with its motion.
    replacing, far = 0.05, 5.0  # std of gap over gap, error of G: samples replace nothing beyond
    cov = fit.crossings_cov + (fit.unexplained * fit.gap) ** 2 / 2.0 * np.diag([0.0, 1.0, 1.0])
    (m, c_r, c_l), apart = known.crossings, fit.crossings - known.crossings
    size = np.array([m, c_r - c_l, c_r - c_l])
    prior = known.cov + np.diag((1e-9 * size) ** 2)
    compatible = agree(fit.crossings, known.crossings, cov + prior, settings.CHANCE)
    if not compatible:
        prior = prior + settings.LOST_MOTION**2 * np.diag(size**2 / [4.0, 2.0, 2.0])
    alike, another = cov + prior, cov + prior + np.diag(size**2)
    if not agree(fit.crossings, known.crossings, alike, settings.CHANCE):
        # A gear that is not pure play leaves systematic residuals, or moves xi too far.
        sure = not fit.systematic and fit.left.turns >= settings.HELD_REVERSALS and \
            gap_variance(cov) < (replacing * fit.gap) ** 2 and fit.error_of_G < far
        if sure and belief.trial.predicted >= belief.trial.must:
            belief = belief._replace(inherited=None)  # it belonged to another plant
        return belief._replace(reason=Status.INCONSISTENT)
    # Samples that tell little contradict nothing: they must speak for it, against another plant.
    odds = log_density(apart, alike) - log_density(apart, another)
    # Where both are further apart than their deviations, these were too small (R. T. Birge).
    widened = prior * max(squares_of(apart, alike) / len(apart), 1.0)
    gain = prior @ np.linalg.pinv(alike)
    joined = Known(known.crossings + gain @ apart, widened - gain @ widened)
    if belief.coasts or (not compatible and fit.systematic):
        joined = known  # a fit that leaves motion unexplained must not move it
    if odds < -log(settings.CHANCE) or not setup.are_precise(*joined, fit.systematic):
        return belief._replace(reason=Status.ACQUIRING)
    reason = Status.INCONSISTENT if setup.moves_unexplained(fit) else Status.TRACKING
    return belief._replace(published=joined, reason=reason)
