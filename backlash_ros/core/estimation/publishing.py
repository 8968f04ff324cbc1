"""What is published of a fit, alone or beside what was known before the run."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation.belief import Belief, Inherited
from backlash_ros.core.estimation.explanations import (
    Setup,
    agree,
    is_known,
    moves_unexplained,
    noisier,
)
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.estimation.settings import HELD_REVERSALS, LOST_MOTION, REVERSALS

REPLACING = 0.05  # std of the gap over the gap, from which samples alone replace what was known


def published(setup: Setup, belief: Belief) -> Belief:
    """The same with what is published of the fit."""
    fit = belief.fit
    assert fit is not None
    if belief.inherited is not None:
        return _beside_inherited(setup, belief, fit, belief.inherited)
    if not is_known(setup, fit, REVERSALS):
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
        white = not fit.systematic and not noisier(setup, fit)
        sure = std < REPLACING * fit.gap and white and fit.turns >= HELD_REVERSALS
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
