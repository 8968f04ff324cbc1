"""The oldest samples of a record go; what they say of theta stays as rows."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.belief import Belief, problem_beside
from backlash_ros.core.estimation.explanations import Record, Setup, problem_of
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.play import NEITHER, RIGHT, engaged, reversals
from backlash_ros.core.estimation.posterior import Fit, Prior, Start
from backlash_ros.core.estimation.settings import HELD_REVERSALS, LIVELY, LONGEST, PREDICTED

Array = NDArray[np.float64]


def excess(setup: Setup, record: Record, problem: Problem, fit: Fit) -> int:
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


def shortened(setup: Setup, record: Record, belief: Belief, cut: int) -> Belief:
    """Let the oldest samples go; what they say of theta stays, discounted as they were."""
    fit = belief.fit
    assert fit is not None
    old = problem_beside(setup, record.until(record.first + cut), belief)
    prior = old.step(replace(fit, knots=np.zeros(0))).prior
    p, _ = old.input(fit)
    start = _start_after(record.v[:cut], p, fit.gap)
    rest = record.since(record.first + cut)
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


def _without_offset(prior: Prior) -> Prior:
    """What a prior says of all but o, which has walked on since."""
    rows = np.column_stack([prior.rows[:, 1], np.delete(prior.rows, 1, axis=1), prior.values])
    r = np.asarray(np.linalg.qr(rows, mode='r'))[1:]
    return Prior(np.insert(r[:, 1:-1], 1, 0.0, axis=1), r[:, -1])
