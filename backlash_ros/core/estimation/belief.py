"""What is believed of the backlash, what is published of it, and what older samples leave of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.explanations import (
    Setup,
    Window,
    agree,
    is_known,
    moves_unexplained,
    noisier,
    problem_of,
)
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.play import NEITHER, RIGHT, engaged, reversals
from backlash_ros.core.estimation.posterior import Prior, Start, WindowFit

Array = NDArray[np.float64]


class State(Enum):
    """How the fit stands to the newest samples; states.py has the table of transitions."""

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
    fit: WindowFit | None = None
    first: int = 0
    end: int = 0
    next_at: int = settings.FIRST_FIT
    thorough_at: int = 0
    older: Prior | None = None
    start: Start | None = None
    candidate: WindowFit | None = None
    tried: WindowFit | None = None
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
        return self.predicted < settings.LASTING * self.must_predict

    @property
    def trusted(self) -> bool:
        """Whether the fit explains its samples and is known well enough."""
        return self.state is State.KNOWN and self.reason is not Status.INCONSISTENT

    @property
    def must_predict_next(self) -> int:
        """How many samples the next explanation must predict once this one is contradicted.

        Twice as many as this one where it did not hold for long: what contradicts one explanation
        after the other is no backlash.
        """
        if not self.on_probation:
            return settings.PREDICTED
        return min(2 * self.must_predict, settings.MOST_PREDICTED)

    def problem(self, setup: Setup, record: Window) -> Problem:
        """The fit of a record beside what is believed of the samples before it."""
        walk_std = self.fit.walk_std if self.fit is not None else 0.0
        return problem_of(setup, record, self.older, self.start, walk_std=walk_std)


# --- what is published --------------------------------------------------------------------------


def published(setup: Setup, belief: Belief) -> Belief:
    """The same with what is published of the fit."""
    fit = belief.fit
    assert fit is not None
    if belief.inherited is not None:
        return _beside_inherited(setup, belief, fit, belief.inherited)
    if not is_known(setup, fit, settings.REVERSALS):
        return replace(belief, reason=Status.INCONSISTENT)
    if belief.predicted < belief.must_predict:
        return belief
    cov = fit.crossings_cov + np.diag(setup.drift**2 * (belief.end - belief.first) / 3.0)
    walked = (fit.walk_std / fit.m) ** 2 * (belief.next_at - belief.end)
    cov += walked * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    return replace(belief, published=fit.crossings, cov=cov, reason=Status.TRACKING)


def _beside_inherited(setup: Setup, belief: Belief, fit: WindowFit, known: Inherited) -> Belief:
    """The same where something was known before the run.

    What the samples leave unexplained may be gap as well, and the lost motion of a gear differs
    from one motion to another.
    """
    replacing = 0.05  # std of the gap over the gap, from which samples alone replace what was known
    doubt = (fit.unexplained * fit.gap) ** 2 / 2.0
    cov = fit.crossings_cov + doubt * np.diag([0.0, 1.0, 1.0])
    gap = known.crossings[1] - known.crossings[2]
    of_motion = (settings.LOST_MOTION * gap) ** 2 / 2.0
    prior = known.cov + 1e-18 * np.diag(known.crossings**2 + gap**2)
    if not agree(fit.crossings, known.crossings, cov + prior):
        prior = prior + np.diag([(0.01 * known.crossings[0]) ** 2, of_motion, of_motion])
    if not agree(fit.crossings, known.crossings, cov + prior):
        std = sqrt(fit.gap_std**2 + 2.0 * doubt)
        # A gear that is no play leaves systematic residuals, and denies nothing.
        white = not fit.systematic and not noisier(setup, fit)
        sure = std < replacing * fit.gap and white and fit.turns >= settings.HELD_REVERSALS
        if sure and belief.predicted >= belief.must_predict:
            belief = replace(belief, inherited=None)  # it was that of another plant
        return replace(belief, reason=Status.INCONSISTENT)
    gain = prior @ np.linalg.pinv(cov + prior)
    joined = known.crossings + gain @ (fit.crossings - known.crossings)
    left = prior - gain @ prior
    if np.trace(left[1:, 1:]) > np.trace(known.cov[1:, 1:]):
        joined, left = known.crossings, known.cov  # agreement makes nothing less certain
    return replace(
        belief, published=joined, cov=left,
        reason=Status.INCONSISTENT if moves_unexplained(setup, fit) else Status.TRACKING,
    )


# --- what older samples leave -------------------------------------------------------------------


def excess(setup: Setup, record: Window, problem: Problem, fit: WindowFit) -> int:
    """How many of the oldest samples may go: the others hold enough reversals.

    Those over which the backlash drifts by more than it is known have to go as well.
    """
    count = len(record.v)
    drift = setup.drift**2 * count / 3.0
    if count > 4 * settings.PREDICTED and (drift > np.diag(fit.crossings_cov)).any():
        return count // 3
    if count < settings.LIVELY:
        return 0
    if count >= settings.LONGEST:
        return count // 3
    turns = reversals(engaged(record.v, problem.input(fit)[0], fit.gap))
    if len(turns) <= settings.HELD_REVERSALS:
        return 0
    cut = min(count // 3, int(turns[-settings.HELD_REVERSALS]) - 1)
    return cut if cut >= count // 6 else 0


def shortened(setup: Setup, record: Window, belief: Belief, cut: int) -> Belief:
    """Let the oldest samples go; what they say of theta stays, discounted as they were."""
    fit = belief.fit
    assert fit is not None
    rest = record.between(record.first + cut)
    old = belief.problem(setup, record.between(record.first, rest.first))
    prior = old.step(replace(fit, knots=np.zeros(0))).prior
    p, _ = old.input(fit)
    sides = engaged(old.v, p, fit.gap)
    right = sides[-1] == RIGHT
    start = None if sides[-1] == NEITHER else Start(float(p[-1] if right else p[-1] - fit.gap),
                                                    not right)
    older = None
    if prior is not None:
        discount = sqrt(fit.inflation)
        older = _drifted(setup, fit, Prior(prior.rows / discount, prior.values / discount), cut)
        if older is not None and fit.walk_std:
            older = _without_offset(older)
    for beside in ((older, start), (None, None)):
        problem = problem_of(setup, rest, *beside, walk_std=fit.walk_std)
        begin = replace(fit, p0=float(p[-1]), x=np.zeros(len(fit.x)), knots=np.zeros(0))
        shorter = problem.finished(problem.fitted(replace(begin, x=problem.state(begin))))
        if shorter.rms < 2.0 * fit.rms or beside[0] is None:
            break
    return replace(
        belief, fit=shorter, first=rest.first, older=beside[0], start=beside[1],
        rejected=frozenset(k for k in belief.rejected if k >= rest.first),
        swapped=frozenset(k for k in belief.swapped if k >= rest.first),
    )


def _drifted(setup: Setup, fit: WindowFit, prior: Prior, samples: int) -> Prior | None:
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


def _without_offset(prior: Prior) -> Prior:
    """What a prior says of all but o, which has walked on since."""
    rows = np.column_stack([prior.rows[:, 1], np.delete(prior.rows, 1, axis=1), prior.values])
    r = np.asarray(np.linalg.qr(rows, mode='r'))[1:]
    return Prior(np.insert(r[:, 1:-1], 1, 0.0, axis=1), r[:, -1])
