"""What is believed of the fit beside what was published and known before."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum, auto

import numpy as np

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.constants import LASTING, PRECISE_GAP, RECOVERED, REPLACING
from backlash_ros.core.estimation.fit.crossings import Crossings, difference
from backlash_ros.core.estimation.fit.prior import beyond_chance, contradicts, prior_of
from backlash_ros.core.estimation.moving_horizon.acceptance import differs, is_precise
from backlash_ros.core.estimation.moving_horizon.learning import Learning

# Motion that no backlash and no G explains, over m times the gap: no more than the gap may be
# uncertain by an error that lasts.
MOST_UNEXPLAINED = PRECISE_GAP * LASTING


class Belief(Enum):
    """What a fit does: it replaces the estimate or only its deviations, nothing, or is refused."""

    REPLACES = auto()
    WIDENS = auto()
    AGREES = auto()
    REFUSED = auto()


def believable(learning: Learning) -> Crossings | None:
    """What the fit says; None if it is of no use.

    What no backlash and no G explains is an error that lasts: all of what chance makes of the
    deviations has to be small, not one of them.
    """
    lasting = learning.around.inherited and learning.fit.solution.moved_otherwise
    return learning.usable(learning.fit, LASTING if lasting else 1.0)


def judged(learning: Learning, found: Crossings | None, estimate: Estimate) -> Belief:
    """What becomes of a fit beside the estimate that held so far.

    found: what the fit says, None if it is of no use.
    Few samples can be fitted by a backlash that never was, and so can many where y moves
    otherwise: after a contradiction a fit has to foretell some, before it says something else
    or says it less precisely. And what was learned before stays as it is until samples that are as
    precise on their own say otherwise, or confirm it: together they would say what neither says.
    """
    held, around, (fit, solution, _) = learning.held, learning.fit.around, learning.fit
    if found is None or learning.fit.contested:
        return Belief.REFUSED
    if held is None:
        return Belief.REPLACES
    if around.inherited and around.prior is not None and solution.alone is None:
        return Belief.AGREES  # so few samples say nothing alone
    proven = learning.consistent >= RECOVERED
    otherwise = solution.moved_otherwise
    wider = bool((found.cov.diagonal() > held.diagonal()).any())
    if beyond_chance(difference(found, estimate), found.cov + held):
        sure = proven and not (otherwise and around.error.count == 0)
        if learning.unconfirmed:
            alone = None if solution.alone is None else solution.alone.crossings
            sure = sure and alone is not None and is_precise(alone, fit.swing, REPLACING)
        return Belief.REPLACES if sure else Belief.REFUSED
    if around.inherited and not learning.expects_changes:
        # Samples that agree with what was known before do not make it less certain.
        sure = not learning.unconfirmed and not wider
        return Belief.REPLACES if sure else Belief.AGREES
    if not otherwise or learning.expects_changes:
        if proven or not wider:
            return Belief.REPLACES
    elif np.linalg.eigvalsh(held - found.cov).max() > 0.0:
        return Belief.REPLACES
    elif proven and around.error.count:
        # With an error of G the deviations hold what moves y otherwise: what held knew of less.
        moved = beyond_chance(difference(found, estimate), held)
        return Belief.REPLACES if moved else Belief.WIDENS
    return Belief.AGREES if proven else Belief.REFUSED


def denied_by_samples(learning: Learning, estimate: Estimate) -> bool:
    """Ask the samples alone about what was learned before; return whether they deny it.

    estimate: what is published of it. Whether they confirm or support it is noted in `learning`.
    They deny what is off by more than an estimate may be uncertain at all. What contradicts
    them by less is neither denied nor confirmed: in a plant that is no backlash and no linear G
    they may be as wrong. So may they where something else moves y, which denies nothing.
    """
    fit, solution, _ = learning.fit
    learning.supported = False
    if not learning.unconfirmed or not learning.reversed_often(fit):
        return False
    alone = solution.alone or fit.solve(alone=True)
    found = alone.crossings
    if found is None or not is_precise(found, fit.swing):
        return False
    known = prior_of(estimate, learning.held)
    contradicted = contradicts(alone.of_theta, known)
    otherwise = solution.moved_otherwise or learning.around.walk > 0.0
    denied = contradicted and differs(found, known) and not otherwise
    if denied or (not contradicted and is_precise(found, fit.swing, REPLACING)):
        learning.unconfirmed = False
    else:
        unexplained = fit.unexplained(solution) * found.gap
        furthest = _furthest(estimate, found, unexplained)
        learning.supported = not contradicted and is_precise(furthest, fit.swing, LASTING)
    return denied


def _furthest(estimate: Estimate, found: Crossings, doubt: float) -> Crossings:
    """What was found, with how far an estimate is from the furthest that it makes likely.

    doubt: of the gap, half of it of each crossing, beside the deviations.
    """
    m, c_r, c_l = np.abs(difference(found, estimate)).tolist()
    gap = abs(found.gap - (estimate.c_r - estimate.c_l))
    return replace(
        found, std_m=m + found.std_m, std_c_r=c_r + found.std_c_r + 0.5 * doubt,
        std_c_l=c_l + found.std_c_l + 0.5 * doubt, std_gap=gap + found.std_gap + doubt,
    )


def load_coasts(learning: Learning, estimate: Estimate) -> bool:
    """Whether the load runs on while v crosses the gap of an estimate that was known before.

    Unlike a lag, which makes the gap seem wider, that makes it seem narrower: y is ahead. And
    y moves by more in a way of its own than the gap may be uncertain where an error lasts.
    """
    fitted = learning.contradiction or learning.current
    alone = None if fitted is None else fitted.solution.alone
    if fitted is None or alone is None or not learning.around.inherited:
        return False
    narrower = alone.gap < estimate.c_r - estimate.c_l
    return narrower and fitted.fit.unexplained(fitted.solution) > MOST_UNEXPLAINED
