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

from dataclasses import dataclass, replace
from enum import Enum, auto
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation.coasting import coasting
from backlash_ros.core.estimation.explanations import (
    Record,
    Setup,
    afresh,
    agree,
    is_known,
    of_xi,
    outliers,
    problem_of,
    spread,
    with_walk,
)
from backlash_ros.core.estimation.fit import FEW_STEPS, Fit, Prior, Problem, Start
from backlash_ros.core.estimation.late_commands import likelier
from backlash_ros.core.estimation.play import NEITHER, RIGHT, engaged, reversals
from backlash_ros.core.estimation.settings import (
    AS_GOOD,
    BLOCKS,
    FEWEST,
    FIRST_FIT,
    GROWTH,
    HELD_REVERSALS,
    LASTING,
    LIVELY,
    LONGEST,
    LOST_MOTION,
    MISFIT,
    MOST_PREDICTED,
    OUTLIER_SHARE,
    PREDICTED,
    UNEXPLAINED,
)

Array = NDArray[np.float64]

REFIT_GROWTH = 1.4  # of the record, after which other gaps and the noise are looked at again
CONTRADICTION = 1e-5  # probability of a block that is no contradiction
UNDECIDED = 100  # samples after which it is said why nothing is known yet
SHORT_SEARCH = 400  # samples of a record in which other gaps are looked for again
ROUNDS = 4  # of fits and commands, found in turn
SHORTEST = 50  # samples of a part of a record that is searched alone
REPLACING = 0.05  # std of the gap over the gap, from which samples alone replace what was known


class State(Enum):
    """How the fit stands to the newest samples; see the table above."""

    SEARCHING = auto()
    KNOWN = auto()
    DOUBTED = auto()


@dataclass(frozen=True)
class Inherited:
    """What was known before the run: m, c_r, c_l (3,) and their covariance (3, 3)."""

    crossings: Array
    cov: Array


@dataclass(frozen=True)
class Belief:
    """What is believed after the samples before `end`.

    first: number of the first sample of the record. older, start: what samples before it say.
    next_at: number of samples at which to look again, thorough_at: for other gaps too. candidate:
    found once. tried: newest fit that is not known well enough. doubt_from: sample from which on
    the fit is contradicted. predicted: samples that the fit has predicted since it was adopted.
    must_predict: how many of them before it is published. adopted_noise: of the fit as adopted.
    published, cov: of m, c_r, c_l, None while nothing was. rejected: numbers of readings
    that are outliers. swapped: numbers of the samples over which the other command acted. coasts:
    whether the load runs on within the gap.
    """

    state: State = State.SEARCHING
    reason: Status = Status.ACQUIRING
    fit: Fit | None = None
    first: int = 0
    end: int = 0
    next_at: int = FIRST_FIT
    thorough_at: int = 0
    older: Prior | None = None
    start: Start | None = None
    candidate: Fit | None = None
    tried: Fit | None = None
    doubt_from: int | None = None
    predicted: int = 0
    must_predict: int = 0
    adopted_noise: float = inf
    published: Array | None = None
    cov: Array | None = None
    inherited: Inherited | None = None
    rejected: frozenset[int] = frozenset()
    swapped: frozenset[int] = frozenset()
    coasts: bool = False

    @property
    def on_probation(self) -> bool:
        """Whether the fit follows one that was contradicted and has not held for long."""
        return self.predicted < LASTING * self.must_predict

    @property
    def trusted(self) -> bool:
        """Whether the fit explains its samples and is known well enough."""
        return self.state is State.KNOWN and self.reason is not Status.INCONSISTENT


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
    coasts = found is not None and found.m > 0.0 and why is Status.INCONSISTENT \
        and _coasts(problem_of(setup, part), found, before.published)
    after = replace(after, tried=found, reason=why, coasts=coasts)
    if found is None or not is_known(setup, found, found.turns):
        return replace(after, candidate=None)
    candidate = before.candidate
    if candidate is None or not agree(
        candidate.crossings, found.crossings, candidate.crossings_cov + found.crossings_cov
    ):
        # A first estimate has to be found twice: some samples alone may mislead.
        return replace(after, candidate=found, next_at=record.end + max(count // BLOCKS, FEWEST))
    # What leaves correlated residuals must predict a quarter as many samples before it is believed.
    systematic = found.count * found.correlation > 1.0
    must = max(before.must_predict, len(part.v) // 4 if systematic else 0)
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
    systematic = found.count * found.correlation > 1.0
    wrong = found.m < 0.0 or (systematic and found.noise > AS_GOOD * _noise(setup, found))
    contradicts = before.published is not None and is_known(setup, found, found.turns)
    return Status.INCONSISTENT if wrong or contradicts else Status.ACQUIRING


def _adopted(setup: Setup, record: Record, fit: Fit, before: Belief) -> Belief:
    """The fit of this record is what is believed."""
    count, must = len(record.v), before.must_predict
    contradicted, noisier = before.fit, before.published is None or fit.walk_std > 0.0
    if contradicted is not None and noisier and agree(
        fit.crossings, contradicted.crossings, fit.crossings_cov + contradicted.crossings_cov
    ):
        must = min(must, PREDICTED)  # another noise, or a walk, but not another backlash
    after = replace(
        before, state=State.KNOWN, must_predict=must, fit=fit, first=record.first, end=record.end,
        candidate=None, tried=None, doubt_from=None,
        next_at=record.end + max(count // BLOCKS, FEWEST),
        thorough_at=int(GROWTH * count), predicted=0, adopted_noise=fit.noise,
    )
    return _published(setup, after)


# --- KNOWN ------------------------------------------------------------------------------------


def _problem(setup: Setup, record: Record, belief: Belief) -> Problem:
    walk_std = belief.fit.walk_std if belief.fit is not None else 0.0
    return problem_of(setup, record, belief.older, belief.start, walk_std=walk_std)


def _known(setup: Setup, record: Record, before: Belief) -> Belief:
    held = before.fit
    assert held is not None
    count, new = len(record.v), before.end - record.first
    problem = _problem(setup, record, before)
    fit = problem.fitted(held, FEW_STEPS)
    since = before.end - setup.family.memory
    record, others = likelier(problem, fit, record, since, before.swapped)
    if others != before.swapped:
        before = replace(before, swapped=others)
        problem = _problem(setup, record, before)
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
    noisier = before.on_probation and fit.noise > AS_GOOD * before.adopted_noise
    if noisier or _contradicts(problem, fit, z, new):
        excess = np.nan_to_num((problem.residual(held)[new:] / held.noise) ** 2 - MISFIT)
        change = int(np.argmax(np.cumsum(excess[::-1])[::-1]))
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
    cut = _excess(setup, record, problem, fit)
    if cut:
        return _published(setup, _shortened(setup, record, after, cut))
    after = _published(setup, after)
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
    if other is None or not is_known(setup, other, 9):
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
    wild = np.abs(z) > 6.0
    mean = float(np.nansum(weights * np.where(wild, 0.0, z**2))) / count
    free = max(count, 1.0)
    limit = max(MISFIT, float(chdtri(free, CONTRADICTION)) / free)
    return mean > limit or float(wild.sum()) > OUTLIER_SHARE * len(z)


def _excess(setup: Setup, record: Record, problem: Problem, fit: Fit) -> int:
    """How many of the oldest samples may go: the others hold enough reversals.

    Those over which the backlash drifts by more than it is known have to go as well.
    """
    count = len(record.v)
    drift = setup.drift**2 * count / 3.0
    if count > 4 * PREDICTED and (drift > np.diag(fit.crossings_cov)).any():
        return count // 3
    if count < LIVELY:
        return 0
    if count >= LONGEST:
        return count // 3
    p, _ = problem.input(fit)
    turns = reversals(engaged(record.v, p, fit.gap))
    if len(turns) <= HELD_REVERSALS:
        return 0
    cut = min(count // 3, int(turns[-HELD_REVERSALS]) - 1)
    return cut if cut >= count // 6 else 0


def _shortened(setup: Setup, record: Record, belief: Belief, cut: int) -> Belief:
    """Let the oldest samples go; what they say of theta stays, discounted as they were."""
    fit = belief.fit
    assert fit is not None
    old = _problem(setup, record.until(record.first + cut), belief)
    prior = old.step(replace(fit, knots=np.zeros(0))).prior
    p, _ = old.input(fit)
    start = _start_after(record.v[:cut], p, fit.gap)
    rest = record.since(record.first + cut)
    older = None
    if prior is not None:
        discount = sqrt(fit.inflation)
        older = _drifted(setup, fit, Prior(prior.rows / discount, prior.values / discount), cut)
        if fit.walk_std:
            older = _without_offset(older)
    for beside in ((older, start), (None, None)):
        problem = problem_of(setup, rest, *beside, walk_std=fit.walk_std)
        begin = replace(fit, p0=float(p[-1]), x=np.zeros(len(fit.x)), knots=np.zeros(0))
        shorter = problem.finished(problem.fitted(replace(begin, x=problem.state(begin))))
        if shorter.rms < 2.0 * fit.rms or beside[0] is None:
            break
    return replace(
        belief, fit=shorter, first=rest.first, older=beside[0], start=beside[1],
        thorough_at=len(rest.v),
        rejected=frozenset(k for k in belief.rejected if k >= rest.first),
        swapped=frozenset(k for k in belief.swapped if k >= rest.first),
    )


def _start_after(v: Array, p: Array, gap: float) -> Start | None:
    """Where the play rests after these samples, if it was engaged within them."""
    sides = engaged(v, p, gap)
    if sides[-1] == NEITHER:
        return None
    right = sides[-1] == RIGHT
    return Start(float(p[-1] if right else p[-1] - gap), not right)


def _drifted(setup: Setup, fit: Fit, prior: Prior, samples: int) -> Prior | None:
    """What is left of a prior after so many samples of drift; None where it says too little."""
    if not setup.drift.any():
        return prior
    rows = prior.rows
    try:
        cov = np.linalg.inv(rows.T @ rows)
    except np.linalg.LinAlgError:
        return None
    theta = np.linalg.lstsq(rows, prior.values, rcond=None)[0]
    m, c_r, _ = fit.crossings
    by = np.array([[1.0, 0.0, 0.0], [c_r, m, 0.0], [0.0, 1.0, -1.0]])  # of m, o, g
    cov[:3, :3] += by @ np.diag(setup.drift**2 * samples) @ by.T
    root = np.linalg.inv(np.linalg.cholesky(cov))
    return Prior(root, root @ theta)


def _without_offset(prior: Prior | None) -> Prior | None:
    """What a prior says of all but o, which has walked on since."""
    if prior is None:
        return None
    rows = np.column_stack([prior.rows[:, 1], np.delete(prior.rows, 1, axis=1), prior.values])
    r = np.asarray(np.linalg.qr(rows, mode='r'))[1:]
    return Prior(np.insert(r[:, 1:-1], 1, 0.0, axis=1), r[:, -1])


# --- what is published ------------------------------------------------------------------------


def _published(setup: Setup, belief: Belief) -> Belief:
    """The same with what is published of the fit."""
    fit = belief.fit
    assert fit is not None
    if belief.inherited is not None:
        return _beside_inherited(setup, belief, fit, belief.inherited)
    if not is_known(setup, fit, 9):
        return replace(belief, reason=Status.INCONSISTENT)
    if belief.predicted < belief.must_predict:
        return belief
    cov = fit.crossings_cov + np.diag(setup.drift**2 * (belief.end - belief.first) / 3.0)
    walked = (fit.walk_std / fit.m) ** 2 * (belief.next_at - belief.end)
    cov += walked * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    return replace(belief, published=fit.crossings, cov=cov, reason=Status.TRACKING)


def _beside_inherited(setup: Setup, belief: Belief, fit: Fit, known: Inherited) -> Belief:
    """The same where something was known before the run.

    What the samples leave unexplained may be gap as well, and the lost motion of a gear differs
    from one motion to another.
    """
    doubt = (fit.unexplained * fit.gap) ** 2 / 2.0
    cov = fit.crossings_cov + doubt * np.diag([0.0, 1.0, 1.0])
    gap = known.crossings[1] - known.crossings[2]
    of_motion = (LOST_MOTION * gap) ** 2 / 2.0
    prior = known.cov + 1e-18 * np.diag(known.crossings**2 + gap**2)
    if not agree(fit.crossings, known.crossings, cov + prior):
        prior = prior + np.diag([(0.01 * known.crossings[0]) ** 2, of_motion, of_motion])
    if not agree(fit.crossings, known.crossings, cov + prior):
        std = sqrt(fit.gap_std**2 + 2.0 * doubt)
        # A gear that is no play leaves systematic residuals, and denies nothing.
        white = fit.count * fit.correlation <= 1.0 and fit.noise < AS_GOOD * _noise(setup, fit)
        sure = std < REPLACING * fit.gap and white and fit.turns >= HELD_REVERSALS
        if sure and belief.predicted >= belief.must_predict:
            belief = replace(belief, inherited=None)  # it was that of another plant
        return replace(belief, reason=Status.INCONSISTENT)
    gain = prior @ np.linalg.pinv(cov + prior)
    joined = known.crossings + gain @ (fit.crossings - known.crossings)
    systematic = fit.count * fit.correlation > 1.0 and setup.family.count > 0
    wrong = systematic and fit.unexplained > UNEXPLAINED
    left = prior - gain @ prior
    if np.trace(left[1:, 1:]) > np.trace(known.cov[1:, 1:]):
        joined, left = known.crossings, known.cov  # agreement makes nothing less certain
    return replace(
        belief, published=joined, cov=left,
        reason=Status.INCONSISTENT if wrong else Status.TRACKING,
    )


def _noise(setup: Setup, fit: Fit) -> float:
    """Standard deviation of a reading as configured, or as its step makes it."""
    return max(setup.noise_std, fit.step / sqrt(12.0))


# --- DOUBTED ----------------------------------------------------------------------------------


def _doubted(setup: Setup, record: Record, before: Belief) -> Belief:
    """The samples since the doubt: over, another backlash, or nothing that explains them."""
    held, since = before.fit, before.doubt_from
    assert held is not None
    assert since is not None
    count, newer = len(record.v), record.end - since
    after = replace(before, end=record.end, candidate=None,
                    next_at=record.end + max(newer // 4, FEWEST))
    problem = _problem(setup, record, before)
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
        if candidate is not None and agree(
            candidate.crossings, found.crossings, candidate.crossings_cov + found.crossings_cov
        ):
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
