"""From a record and what was believed before to what is believed now: a pure function.

| state     | meaning                     | published            | left for, when              |
|-----------|-----------------------------|----------------------|-----------------------------|
| SEARCHING | no fit explains the record  | first guess, or what | KNOWN: a fit is known well  |
|           |                             | was known before     | enough, twice in a row      |
| KNOWN     | the fit explains all        | the fit              | DOUBTED: newer samples      |
|           | samples                     |                      | contradict it               |
| DOUBTED   | newer samples contradict    | the fit before them  | KNOWN: it predicts samples  |
|           | the fit                     |                      | again, or another backlash  |
|           |                             |                      | explains the newer ones;    |
|           |                             |                      | SEARCHING: nothing does for |
|           |                             |                      | as long as a search looks   |

What was known before the run (`Inherited`) is joined with what the samples say as long as they
agree; where they contradict it, and are precise on their own, it is dropped.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.belief import Belief, State, excess, published, shortened
from backlash_ros.core.estimation.coasting import coasts
from backlash_ros.core.estimation.explanations import (
    Setup,
    Window,
    afresh,
    alike,
    is_known,
    noisier,
    of_xi,
    outliers,
    problem_of,
    spread,
    with_intervals,
    with_walk,
)
from backlash_ros.core.estimation.fit import FEW_STEPS, Problem
from backlash_ros.core.estimation.late_commands import likelier
from backlash_ros.core.estimation.play import engaged, play, reversals
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.estimation.settings import FEWEST, MISFIT, PREDICTED

Array = NDArray[np.float64]

SHORT_SEARCH = 400  # samples of a record in which other gaps are looked for again


def learn(setup: Setup, record: Window, before: Belief) -> Belief:
    """What is believed with the samples of this record, which begins at `before.first`.

    Raises nothing: where the numbers get too large, it begins anew with the newest samples.
    """
    look = {State.SEARCHING: _searching, State.KNOWN: _known, State.DOUBTED: _doubted}
    try:
        with np.errstate(all='ignore'):
            return look[before.state](setup, record.without(before.rejected), before)
    except np.linalg.LinAlgError:
        first = max(record.end - settings.FIRST_FIT, record.first)
        return _begun_anew(before, first, record.end, record.end + FEWEST)


def _begun_anew(before: Belief, first: int, end: int, next_at: int) -> Belief:
    """Nothing is known of the samples; what was published stays."""
    reason = Status.INCONSISTENT if before.fit is not None else before.reason
    return replace(
        before, state=State.SEARCHING, reason=reason, fit=None, first=first, end=end,
        next_at=next_at, older=None, start=None, candidate=None, doubt_from=None,
    )


# --- SEARCHING --------------------------------------------------------------------------------


def _searching(setup: Setup, record: Window, before: Belief) -> Belief:
    shortest = 50  # samples of a part of a record that is searched alone
    count, tried = len(record.v), before.tried
    soon = record.end + max(count // settings.BLOCKS, FEWEST)
    # What many reversals do not tell, a few more will not.
    lasting = tried is not None and tried.turns >= settings.HELD_REVERSALS
    growth = settings.SEARCHED if lasting else settings.GROWTH
    search_at = record.end + max(int(count * (growth - 1.0)), FEWEST)
    after = replace(before, end=record.end, next_at=search_at, thorough_at=search_at)
    if tried is not None and before.candidate is None and record.end < before.thorough_at \
            and not is_known(setup, tried, _turns(record, max(tried.gap, 0.0), tried.p0)):
        return replace(after, next_at=soon, thorough_at=before.thorough_at)
    found = afresh(setup, record, also=before.candidate or before.tried, walks=True)
    part = shorter = record
    why = _why(setup, found, record, before)
    while why in (Status.INCONSISTENT, Status.NOT_EXCITED) and len(shorter.v) >= 3 * shortest:
        # What happened at its beginning may have spoilt a record.
        shorter = shorter.between(shorter.end - len(shorter.v) // 3)
        newest = afresh(setup, shorter)
        if newest is not None and is_known(setup, newest, newest.turns):
            found, part = newest, shorter
            break
    if found is None:
        return replace(after, tried=None, reason=why, coasts=False, candidate=None)
    found, swapped = _with_commands(setup, part, found, before.swapped)
    runs_on = found.m > 0.0 and _leaves_more(setup, found) \
        and coasts(problem_of(setup, part), found, before.published)
    after = replace(
        after, swapped=swapped, tried=found, coasts=runs_on,
        reason=Status.INCONSISTENT if runs_on else why,
    )
    if not is_known(setup, found, found.turns):
        if is_known(setup, found, settings.REVERSALS):  # but for a reversal, which may come soon
            after = replace(after, next_at=soon)
        return replace(after, candidate=None)
    if before.candidate is None or not alike(before.candidate, found):
        # A first estimate has to be found twice: some samples alone may mislead.
        return replace(after, candidate=found, next_at=soon)
    # What leaves more than noise must predict a quarter as many samples before it is believed.
    more = found.systematic or noisier(setup, found)
    must = max(before.must_predict, len(part.v) // 4 if more else 0)
    after = replace(after, older=None, start=None, must_predict=must)
    return _adopted(setup, part, found, after)


def _with_commands(
    setup: Setup, record: Window, found: WindowFit, swapped: frozenset[int],
) -> tuple[WindowFit, frozenset[int]]:
    """The fit and the commands that go with each other, found in turn.

    Commands that leave more than noise explain nothing: those that were sent stay.
    """
    if not np.isfinite(record.other).any():
        return found, swapped
    fit, others = found, swapped
    for _ in range(4):
        before = others
        record, others = likelier(problem_of(setup, record), fit, record, record.first, before)
        if others == before:
            break
        fit = afresh(setup, record, also=fit) or fit
    return (found, swapped) if _leaves_more(setup, fit) else (fit, others)


def _why(setup: Setup, found: WindowFit | None, record: Window, before: Belief) -> Status:
    """What to say while nothing is known."""
    if len(record.v) < 100 and before.reason is Status.ACQUIRING:
        return Status.ACQUIRING
    known = before.published
    if found is None:
        crosses = known is not None and np.ptp(record.v) > known[1] - known[2]
        return Status.INCONSISTENT if crosses else Status.NOT_EXCITED
    # Until v has swung past the gap a fit may have none: the gap of the first guess counts then.
    gap = max(found.gap, setup.guess)
    turns = _turns(record, gap, float(record.v[0]))
    large = found.unexplained * found.gap > settings.UNEXPLAINED * gap \
        or turns >= settings.HELD_REVERSALS
    wrong = found.m < 0.0 or (large and _leaves_more(setup, found))
    contradicts = known is not None and is_known(setup, found, found.turns)
    return Status.INCONSISTENT if wrong or contradicts else Status.ACQUIRING


def _turns(record: Window, gap: float, p0: float) -> int:
    return len(reversals(engaged(record.v, play(record.v, gap, p0), gap)))


def _leaves_more(setup: Setup, found: WindowFit) -> bool:
    """Whether a fit leaves more than noise, and correlated."""
    return found.systematic and noisier(setup, found)


def _adopted(setup: Setup, record: Window, fit: WindowFit, before: Belief) -> Belief:
    """The fit of this record is what is believed."""
    count, must = len(record.v), before.must_predict
    another_noise = before.published is None or fit.walk_std > 0.0
    if before.fit is not None and another_noise and alike(fit, before.fit):
        must = min(must, PREDICTED)  # another noise, or a walk, but not another backlash
    return published(setup, replace(
        before, state=State.KNOWN, must_predict=must, fit=fit, first=record.first, end=record.end,
        candidate=None, tried=None, doubt_from=None,
        next_at=record.end + max(count // settings.BLOCKS, FEWEST),
        thorough_at=record.end + count // 4, predicted=0, adopted_noise=fit.noise,
    ))


# --- KNOWN ------------------------------------------------------------------------------------


def _known(setup: Setup, record: Window, before: Belief) -> Belief:
    held = before.fit
    assert held is not None
    count, new = len(record.v), before.end - record.first
    problem = before.problem(setup, record)
    fit = problem.fitted(held, FEW_STEPS)
    since = before.end - setup.family.memory
    record, others = likelier(problem, fit, record, since, before.swapped)
    if others != before.swapped:
        before = replace(before, swapped=others)
        problem = before.problem(setup, record)
        fit = problem.fitted(fit, FEW_STEPS)
    z = problem.residual(fit)[new:] / held.noise
    wild = outliers(z)
    if wild.any():
        numbers = frozenset((record.first + new + np.flatnonzero(wild)).tolist())
        cleaned = replace(before, rejected=before.rejected | numbers)
        return _known(setup, record.without(numbers), cleaned)
    # What was known before the run is not to be moved by samples that the fit does not explain.
    rho = held.correlation if before.inherited is None else 0.0
    if _contradicts(problem, held, fit, new, rho):
        fit = problem.fitted(held)  # before anything is blamed
    grown = before.on_probation and fit.noise > settings.AS_GOOD * before.adopted_noise
    if grown or _contradicts(problem, held, fit, new, rho):
        beyond = np.nan_to_num((problem.residual(held)[new:] / held.noise) ** 2 - MISFIT)
        change = int(np.argmax(np.cumsum(beyond[::-1])[::-1]))
        return replace(
            before, state=State.DOUBTED, end=record.end, candidate=None,
            doubt_from=record.first + new + change, next_at=record.end + FEWEST,
            must_predict=before.must_predict_next,
            reason=Status.INCONSISTENT if before.on_probation else before.reason,
        )
    after = replace(
        before, end=record.end, next_at=record.end + max(count // settings.BLOCKS, FEWEST),
        predicted=before.predicted + count - new,
    )
    if record.end >= before.thorough_at:
        after = replace(after, thorough_at=record.end + 2 * count // 5)
        short = count <= SHORT_SEARCH and before.older is None
        fit = with_intervals(problem, fit)
        if fit.spread.any():  # else it has been normal for long
            fit = replace(fit, spread=spread(problem, fit))
        fit = _beside_others(setup, record, problem, fit) if short else fit
        fit = with_walk(setup, problem, fit)
    else:
        fit = problem.finished(fit)
    after = replace(after, fit=fit)
    cut = excess(setup, record, problem, fit)
    if cut:
        return published(setup, shortened(setup, record, after, cut))
    after = published(setup, after)
    wrong = after.reason is Status.INCONSISTENT
    return replace(after, coasts=wrong and coasts(problem, fit))


def _beside_others(setup: Setup, record: Window, problem: Problem, fit: WindowFit) -> WindowFit:
    """The fit of a short record, or another one that is likelier, mixed with each other."""
    other = afresh(setup, record)
    if other is None or not is_known(setup, other, settings.REVERSALS):
        return fit
    best = other if other.evidence > fit.evidence + 3.0 else fit
    return replace(best, spread=spread(problem, best, [fit, other]))


def _contradicts(
    problem: Problem, held: WindowFit, fit: WindowFit, new: int, rho: float,
) -> bool:
    """Whether the samples from `new` on contradict what was held, and `fit` that takes them in.

    They do as well where it takes them in at the cost of all others. rho: correlation of residuals.
    """
    weights = problem.weights(fit)
    z = problem.residual(fit) / held.noise
    if float(np.nanmean(z**2)) > _most(settings.AS_GOOD**2, float(weights.sum()), rho):
        return True
    weights, z = weights[new:], z[new:]
    seen = np.isfinite(z)
    count = float(weights[seen].sum())
    if not count:
        return False
    wild = np.abs(z) > settings.GATE
    mean = float(np.nansum(weights * np.where(wild, 0.0, z**2))) / count
    return mean > _most(MISFIT, count, rho) \
        or float(wild.sum()) > settings.OUTLIER_SHARE * int(seen.sum())


def _most(least: float, count: float, rho: float) -> float:
    """Mean square of so many normalized residuals that is no chance: correlated ones are fewer."""
    from scipy.special import chdtri  # where fits are made: 31 MB

    free = max(count / (1.0 + (count - 1.0) * rho), 1.0)
    return max(least, float(chdtri(free, 1e-5)) / free)


# --- DOUBTED ----------------------------------------------------------------------------------


def _doubted(setup: Setup, record: Window, before: Belief) -> Belief:
    """The samples since the doubt: over, another backlash, or nothing that explains them."""
    held, since = before.fit, before.doubt_from
    assert held is not None
    assert since is not None
    count, newer = len(record.v), record.end - since
    after = replace(before, end=record.end, candidate=None,
                    next_at=record.end + max(newer // 4, FEWEST))
    z = before.problem(setup, record).residual(held) / held.noise
    if newer >= 2 * PREDICTED and np.nanmean(z[-PREDICTED:] ** 2) < MISFIT:
        # Whatever it was, it is over: what was measured meanwhile says nothing.
        lost = frozenset(range(since, record.end - PREDICTED))
        return replace(
            after, state=State.KNOWN, doubt_from=None, rejected=before.rejected | lost,
            end=record.end - 1, next_at=record.end,
        )
    if newer >= PREDICTED:
        after = replace(after, reason=Status.INCONSISTENT)
    short = max(SHORT_SEARCH, 4 * setup.family.memory)
    explained = settings.AS_GOOD * held.noise
    whole = None
    if count <= max(short, 4 * newer) and count < settings.LONGEST:
        whole = afresh(setup, record, walks=newer >= 2 * PREDICTED)
        if whole is not None and not whole.rms < explained:
            whole = None
    for first in (since, (since + record.end) // 2):
        part = record.between(first)
        found = afresh(setup, part, like=held) if len(part.v) >= PREDICTED else None
        if found is None or found.rms > explained \
                or not is_known(setup, found, found.turns + (setup.family.count > 0)):
            continue
        apart = held.evidence + found.evidence - 0.5 * (4 + len(held.x)) * np.log(len(part.v))
        if whole is not None and whole.evidence > apart:
            break
        if before.candidate is None or not alike(before.candidate, found):
            return replace(after, candidate=found)
        return _adopted(setup, part, found, replace(after, older=of_xi(held), start=None))
    if whole is not None and is_known(setup, whole, whole.turns):
        return _adopted(setup, record, whole, replace(after, older=None, start=None))
    # Two reversals of the record take so long, on average.
    if newer > max(short, 2 * count // max(held.turns, 1)):
        return _begun_anew(after, since, record.end, record.end + 1)
    return after
