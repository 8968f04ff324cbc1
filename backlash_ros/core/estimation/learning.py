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
from backlash_ros.core.estimation.belief import Belief, State, problem_beside
from backlash_ros.core.estimation.coasting import coasting
from backlash_ros.core.estimation.explanations import (
    Record,
    Setup,
    afresh,
    alike,
    is_known,
    noisier,
    of_xi,
    outliers,
    problem_of,
    spread,
    with_walk,
)
from backlash_ros.core.estimation.fit import FEW_STEPS, Problem
from backlash_ros.core.estimation.forgetting import excess, shortened
from backlash_ros.core.estimation.late_commands import likelier
from backlash_ros.core.estimation.play import engaged, play, reversals
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.estimation.publishing import published
from backlash_ros.core.estimation.settings import (
    AS_GOOD,
    BLOCKS,
    FEWEST,
    FIRST_FIT,
    GATE,
    GROWTH,
    HELD_REVERSALS,
    LONGEST,
    MISFIT,
    MOST_PREDICTED,
    OUTLIER_SHARE,
    PREDICTED,
    REVERSALS,
    UNEXPLAINED,
)

Array = NDArray[np.float64]

REFIT_GROWTH = 1.4  # of the record, after which other gaps and the noise are looked at again
CONTRADICTION = 1e-5  # probability of a block that is no contradiction
UNDECIDED = 100  # samples after which it is said why nothing is known yet
SHORT_SEARCH = 400  # samples of a record in which other gaps are looked for again
ROUNDS = 4  # of fits and commands, found in turn
SHORTEST = 50  # samples of a part of a record that is searched alone


def learn(setup: Setup, record: Record, before: Belief) -> Belief:
    """What is believed with the samples of this record, which begins at `before.first`.

    Raises nothing: where the numbers get too large, it begins anew with the newest samples.
    """
    try:
        with np.errstate(all='ignore'):
            known = _without(record, before.rejected)
            if before.state is State.SEARCHING:
                return _searching(setup, known, before)
            if before.state is State.DOUBTED:
                return _doubted(setup, known, before)
            return _known(setup, known, before)
    except np.linalg.LinAlgError:
        return _begun_anew(before, max(record.end - FIRST_FIT, record.first), record.end)


def _without(record: Record, rejected: frozenset[int]) -> Record:
    """The record without these readings."""
    numbers = [k - record.first for k in rejected if record.first <= k < record.end]
    if not numbers:
        return record
    y = record.y.copy()
    y[numbers] = np.nan
    return record._replace(y=y)


def _begun_anew(before: Belief, first: int, end: int) -> Belief:
    """Nothing is known of the samples; what was published stays."""
    return replace(
        before, state=State.SEARCHING, reason=Status.INCONSISTENT, fit=None, first=first, end=end,
        next_at=end + FEWEST, older=None, start=None, candidate=None, doubt_from=None,
    )


# --- SEARCHING --------------------------------------------------------------------------------


def _searching(setup: Setup, record: Record, before: Belief) -> Belief:
    count = len(record.v)
    after = replace(before, end=record.end,
                    next_at=record.end + max(int(count * (GROWTH - 1.0)), FEWEST))
    found = afresh(setup, record, also=before.candidate or before.tried, walks=True)
    part = record
    why = _why(setup, found, record, before)
    shorter = record
    while why in (Status.INCONSISTENT, Status.NOT_EXCITED) and len(shorter.v) >= 3 * SHORTEST:
        # What happened at its beginning may have spoilt a record.
        shorter = shorter.since(shorter.end - len(shorter.v) // 3)
        newest = afresh(setup, shorter)
        if newest is not None and is_known(setup, newest, newest.turns):
            found, part = newest, shorter
            break
    if found is not None:
        found, others = _with_commands(setup, part, found, before.swapped)
        after = replace(after, swapped=others)
    coasts = found is not None and found.m > 0.0 and _leaves_more(setup, found) \
        and _coasts(problem_of(setup, part), found, before.published)
    reason = Status.INCONSISTENT if coasts else why
    after = replace(after, tried=found, reason=reason, coasts=coasts)
    if found is None or not is_known(setup, found, found.turns):
        return replace(after, candidate=None)
    candidate = before.candidate
    if candidate is None or not alike(candidate, found):
        # A first estimate has to be found twice: some samples alone may mislead.
        return replace(after, candidate=found, next_at=record.end + max(count // BLOCKS, FEWEST))
    # What leaves more than noise must predict a quarter as many samples before it is believed.
    more = found.systematic or noisier(setup, found)
    must = max(before.must_predict, len(part.v) // 4 if more else 0)
    after = replace(after, older=None, start=None, must_predict=must)
    return _adopted(setup, part, found, after)


def _coasts(problem: Problem, fit: Fit, known: Array | None) -> bool:
    """Whether the load runs on within the gap: that of the fit, or the one known before.

    known: m, c_r, c_l (3,). The fit of a load that coasts may have next to no gap.
    """
    if known is not None:
        m, c_r, c_l = known.tolist()
        theta = np.concatenate([[m, m * c_r, c_r - c_l], fit.theta[3:]])
        there = replace(fit, theta=theta, p0=float(problem.v[0]) + 0.5 * (c_r - c_l), x=fit.x * 0.0)
        there = replace(there, x=problem.state(there))
        rms = float(np.sqrt(np.nanmean(problem.residual(there) ** 2)))
        if coasting(problem, replace(there, rms=rms)).found:
            return True
    return coasting(problem, fit).found


def _with_commands(
    setup: Setup, record: Record, found: Fit, swapped: frozenset[int],
) -> tuple[Fit, frozenset[int]]:
    """The fit and the commands that go with each other, found in turn."""
    if not np.isfinite(record.other).any():
        return found, swapped
    for _ in range(ROUNDS):
        part = problem_of(setup, record)
        record, others = likelier(part, found, record, record.first, swapped)
        if others == swapped:
            break
        swapped = others
        found = afresh(setup, record, also=found) or found
    return found, swapped


def _why(setup: Setup, found: Fit | None, record: Record, before: Belief) -> Status:
    """What to say while nothing is known."""
    if len(record.v) < UNDECIDED and before.reason is Status.ACQUIRING:
        return Status.ACQUIRING
    if found is None:
        known = before.published
        crosses = known is not None and np.ptp(record.v) > known[1] - known[2]
        return Status.INCONSISTENT if crosses else Status.NOT_EXCITED
    # Until v has swung past the gap a fit may have none: the gap of the first guess counts then.
    gap = max(found.gap, setup.guess)
    turns = len(reversals(engaged(record.v, play(record.v, gap, float(record.v[0])), gap)))
    large = found.unexplained * found.gap > UNEXPLAINED * gap or turns >= HELD_REVERSALS
    wrong = found.m < 0.0 or (large and _leaves_more(setup, found))
    contradicts = before.published is not None and is_known(setup, found, found.turns)
    return Status.INCONSISTENT if wrong or contradicts else Status.ACQUIRING


def _leaves_more(setup: Setup, found: Fit) -> bool:
    """Whether a fit leaves more than noise, and correlated."""
    return found.systematic and noisier(setup, found)


def _adopted(setup: Setup, record: Record, fit: Fit, before: Belief) -> Belief:
    """The fit of this record is what is believed."""
    count, must = len(record.v), before.must_predict
    another_noise = before.published is None or fit.walk_std > 0.0
    if before.fit is not None and another_noise and alike(fit, before.fit):
        must = min(must, PREDICTED)  # another noise, or a walk, but not another backlash
    after = replace(
        before, state=State.KNOWN, must_predict=must, fit=fit, first=record.first, end=record.end,
        candidate=None, tried=None, doubt_from=None,
        next_at=record.end + max(count // BLOCKS, FEWEST),
        thorough_at=int(GROWTH * count), predicted=0, adopted_noise=fit.noise,
    )
    return published(setup, after)


# --- KNOWN ------------------------------------------------------------------------------------


def _known(setup: Setup, record: Record, before: Belief) -> Belief:
    held = before.fit
    assert held is not None
    count, new = len(record.v), before.end - record.first
    problem = problem_beside(setup, record, before)
    fit = problem.fitted(held, FEW_STEPS)
    since = before.end - setup.family.memory
    record, others = likelier(problem, fit, record, since, before.swapped)
    if others != before.swapped:
        before = replace(before, swapped=others)
        problem = problem_beside(setup, record, before)
        fit = problem.fitted(fit, FEW_STEPS)
    z = problem.residual(fit)[new:] / held.noise
    wild = outliers(z)
    if wild.any():
        numbers = frozenset((record.first + new + np.flatnonzero(wild)).tolist())
        cleaned = replace(before, rejected=before.rejected | numbers)
        return _known(setup, _without(record, numbers), cleaned)
    if _contradicts(problem, fit, z, new):
        fit = problem.fitted(held)  # before anything is blamed
        z = problem.residual(fit)[new:] / held.noise
    grown = before.on_probation and fit.noise > AS_GOOD * before.adopted_noise
    if grown or _contradicts(problem, fit, z, new):
        beyond = np.nan_to_num((problem.residual(held)[new:] / held.noise) ** 2 - MISFIT)
        change = int(np.argmax(np.cumsum(beyond[::-1])[::-1]))
        return replace(
            before, state=State.DOUBTED, end=record.end, candidate=None,
            doubt_from=record.first + new + change, next_at=record.end + FEWEST,
            must_predict=_must_predict(before),
            reason=Status.INCONSISTENT if before.on_probation else before.reason,
        )
    after = replace(
        before, end=record.end, next_at=record.end + max(count // BLOCKS, FEWEST),
        predicted=before.predicted + count - new,
    )
    if count >= before.thorough_at:
        after = replace(after, thorough_at=int(REFIT_GROWTH * count))
        if count <= SHORT_SEARCH and before.older is None:
            fit = _beside_others(setup, record, problem, fit)
        else:
            fit = replace(problem.with_intervals(fit), spread=fit.spread * 0.0)
        fit = with_walk(problem, fit)
    else:
        fit = problem.finished(fit)
    after = replace(after, fit=fit)
    cut = excess(setup, record, problem, fit)
    if cut:
        return published(setup, shortened(setup, record, after, cut))
    after = published(setup, after)
    wrong = after.reason is Status.INCONSISTENT
    return replace(after, coasts=wrong and coasting(problem, fit).found)


def _must_predict(contradicted: Belief) -> int:
    """How many samples the next explanation has to predict before it is published.

    Twice as many as this one where it did not hold for long: what contradicts one explanation after
    the other is no backlash.
    """
    must = contradicted.must_predict
    return min(2 * must, MOST_PREDICTED) if contradicted.on_probation else PREDICTED


def _beside_others(setup: Setup, record: Record, problem: Problem, fit: Fit) -> Fit:
    """The fit of a short record, or another one that is likelier, mixed with each other."""
    fit = replace(problem.with_intervals(fit), spread=fit.spread * 0.0)
    other = afresh(setup, record)
    if other is None or not is_known(setup, other, REVERSALS):
        return fit
    fit, other = problem.comparable([fit, other])
    best = other if other.evidence > fit.evidence + 3.0 else fit
    return replace(best, spread=spread(best, [fit, other]))


def _contradicts(problem: Problem, fit: Fit, z: Array, new: int) -> bool:
    """Whether the samples from `new` on contradict the fit that has taken them in.

    z: their residuals over the noise that was known before.
    """
    from scipy.special import chdtri  # where fits are made: 31 MB

    weights = problem.weights(problem.output(fit))[new:]
    count = float(weights[np.isfinite(z)].sum())
    if not count:
        return False
    wild = np.abs(z) > GATE
    mean = float(np.nansum(weights * np.where(wild, 0.0, z**2))) / count
    free = max(count, 1.0)
    limit = max(MISFIT, float(chdtri(free, CONTRADICTION)) / free)
    return mean > limit or float(wild.sum()) > OUTLIER_SHARE * len(z)


# --- DOUBTED ----------------------------------------------------------------------------------


def _doubted(setup: Setup, record: Record, before: Belief) -> Belief:
    """The samples since the doubt: over, another backlash, or nothing that explains them."""
    held, since = before.fit, before.doubt_from
    assert held is not None
    assert since is not None
    count, newer = len(record.v), record.end - since
    after = replace(before, end=record.end, candidate=None,
                    next_at=record.end + max(newer // 4, FEWEST))
    problem = problem_beside(setup, record, before)
    z = problem.residual(held) / held.noise
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
    whole = None
    if count <= max(short, 4 * newer) and count < LONGEST:
        whole = afresh(setup, record, walks=newer >= 2 * PREDICTED)
    explained = AS_GOOD * held.noise
    known_xi = of_xi(held, setup.family.count)
    for first in (since, (since + record.end) // 2):
        part = record.since(first)
        if len(part.v) < PREDICTED:
            continue
        found = afresh(setup, part, known_xi, held.theta[3:], held.scale)
        if found is None or found.rms > explained \
                or not is_known(setup, found, found.turns + (known_xi is not None)):
            continue
        if whole is not None and whole.rms < explained:
            apart = held.evidence + found.evidence
            apart -= 0.5 * (4 + len(held.x)) * np.log(len(part.v))
            if whole.evidence > apart:
                break
        candidate = before.candidate
        if candidate is not None and alike(candidate, found):
            changed = replace(after, older=known_xi, start=None)
            return _adopted(setup, part, found, changed)
        return replace(after, candidate=found)
    if whole is not None and whole.rms < explained and is_known(setup, whole, whole.turns):
        return _adopted(setup, record, whole, replace(after, older=None, start=None))
    if newer > max(short, _motion(record, held)):
        return replace(_begun_anew(after, since, record.end), next_at=record.end + 1)
    return after


def _motion(record: Record, fit: Fit) -> int:
    """Samples that two reversals of the record take, on average."""
    return 2 * len(record.v) // max(fit.turns, 1)
