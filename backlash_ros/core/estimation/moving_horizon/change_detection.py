"""What becomes of the fit where samples contradict it: another explanation, or a shorter record."""

from __future__ import annotations

from collections.abc import Generator
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.estimation.constants import (
    AS_GOOD,
    BLOCK,
    MISFIT,
    OUTLIER_SHARE,
    RECOVERED,
    REPLACING,
    SEARCH_GROWTH,
    SEARCHED,
)
from backlash_ros.core.estimation.fit.prior import Prior, contradicts
from backlash_ros.core.estimation.fit.relabelling import (
    Fitted,
    fitted,
    most_likely,
    searched,
)
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.moving_horizon.acquisition import (
    confirmed,
    fitted_around,
    searched_with_commands,
)
from backlash_ros.core.estimation.moving_horizon.learning import Learning, Task
from backlash_ros.core.estimation.observer.record_attribution import with_other_commands

Array = NDArray[np.float64]


def note_block(learning: Learning, fits: bool, number: int, squares: Array) -> None:
    """Note from when on the samples contradict the fit, or that they fit again.

    fits: whether those from `number` on do. squares: of their residuals, normalised, shape (N,).
    """
    if fits:
        count = len(squares)
        learning.consistent += count
        since = learning.contradicted_from
        if since is not None and learning.consistent >= RECOVERED:
            # Whatever it was, it is over: what was measured meanwhile says nothing.
            learning.record.lose(np.arange(since, number + count - learning.consistent))
            learning.contradicted_from = learning.contradiction = None
        return
    if learning.contradicted_from is None:
        learning.agreed = learning.consistent
        learning.contradicted_from = learning.next_try = number + change(squares)
    learning.consistent = 0


def change(squares: Array) -> int:
    """Where samples begin to contradict a fit, from the normalised squares of residuals (N,).

    The likeliest sample of a change after which their mean is beyond MISFIT (cumulative sum test:
    E. S. Page, Continuous inspection schemes, Biometrika 41 (1954) 100-115).
    """
    excess = np.where(np.isfinite(squares), squares - MISFIT, 0.0)
    return int(np.argmax(np.cumsum(excess[::-1])[::-1]))


def halve(learning: Learning) -> Task:
    """Let the older half of the record go where the newer one contradicts the whole.

    Or where theta, as told, drifts by more than its deviation meanwhile.
    """
    record, (fit, solution, _), pace = learning.record, learning.fit, learning.pace
    learning.next_try = record.end + max(fit.length // 4, BLOCK[1])
    half = fit.length // 2
    if half < RECOVERED:
        return False
    v, y = learning.taken_since(record.first)
    around = learning.unchanged
    start = fit.start_after(v[:half]).with_gap(solution.gap, v[half:])
    newer = yield from fitted(v[half:], y[half:], around, start, solution.m, pace)
    if learning.usable(newer, REPLACING) is None:
        return False
    whole = Prior(solution.theta, np.zeros((3, 3)))
    if not (contradicts(newer.solution.of_theta, whole)
            or learning.drifts_more(newer.solution, half)):
        return False
    if around.inherited:
        known = learning.around.prior
        # A lag may pass for a gap, and what was known before the record may hold on.
        if not learning.reversed_often(newer.fit) or not (
            known is None or contradicts(newer.solution.of_theta, known)
        ):
            return False
    if learning.expects_changes and not around.error.count:
        # What the older half says holds as far as theta has not drifted since.
        older = yield from fitted(
            v[:half], y[:half], learning.around._replace(walk=0.0), fit.start, solution.m, pace
        )
        prior = learning.drifted(older.solution.of_theta, half)
        if older.solution.m > 0.0 and not contradicts(newer.solution.of_theta, prior):
            newer = yield from fitted(
                v[half:], y[half:], around._replace(prior=prior), newer.fit.start, solution.m, pace
            )
    return learning.go_on_from(newer, record.first + half, changed=True)


def reconsider(learning: Learning, estimate: Estimate) -> Task:
    """Explain samples that contradict the fit: by all of them, or by a change of the plant.

    estimate: the published one.
    """
    current, since, record = learning.fit, learning.contradicted_from, learning.record
    assert since is not None
    bound = AS_GOOD * current.solution.posterior.noise_std
    around, end = learning.unchanged, record.end
    learning.next_try = end + max(int((end - since) * (SEARCH_GROWTH - 1.0)), BLOCK[0])
    late = yield from _by_other_commands(learning, since, bound)
    if late is not None:
        # There was no contradiction.
        learning.consistent = learning.agreed + end - learning.waiting - since
        return learning.go_on_from(late, record.first)
    # What is known from elsewhere still holds, unless the plant has changed.
    whole = yield from _best_of_all(learning, learning.around._replace(walk=0.0))
    if whole is not None and _explains(whole, since - record.first, bound):
        return learning.go_on_from(whole, record.first)
    # What is known from elsewhere may have changed before the record began.
    earliest = [record.first] if learning.around.prior is not None else []
    before, learning.changed = learning.changed, None
    changes = []
    for first in (*earliest, since, (since + end) // 2):
        first = max(first, end - SEARCHED)
        if end - first < RECOVERED:
            continue
        v, y = record.since(first)
        found, commands = yield from searched_with_commands(learning, first, v, y, around)
        if found is not None:
            changes.append(found)
            if (learning.reversed_often(found.fit) or not around.inherited) \
                    and learning.usable(found, REPLACING) is not None \
                    and found.solution.rms <= bound \
                    and _has_changed(current, found, whole, first == record.first):
                theta = learning.changed = found.solution.of_theta
                # As a first estimate, one that nobody expects is to be found twice.
                again = before is not None and not contradicts(theta, before)
                if again or learning.expects_changes:
                    learning.believe(commands, first)
                    return learning.go_on_from(found, first, changed=True)
        # The same backlash, but something has moved the plant meanwhile.
        kept = yield from confirmed(learning, v, y, estimate, found)
        if kept is not None and kept.solution.rms <= bound \
                and _has_changed(current, kept, whole):
            return learning.go_on_from(kept, first)
    if whole is not None and changes and not any(
        _has_changed(current, found, whole) for found in changes
    ):
        return learning.go_on_from(whole, record.first)
    if end - since >= RECOVERED:
        learning.reason = Status.INCONSISTENT
        if around.inherited:
            # The newest samples around what was known, though it does not explain them.
            v, y = record.since(max(record.first, end - SEARCHED))
            learning.contradiction = yield from fitted_around(
                learning, v, y, estimate, learning.around._replace(walk=0.0)
            )
    if end - since > SEARCHED:
        learning.begin_acquisition(estimate)
    return False


def _explains(result: Fitted, newest: int, bound: float) -> bool:
    """Whether a fit explains the samples from number `newest` of it on; bound: on its residual."""
    return result.solution.rms <= bound and result.fit.misfit(result.solution, newest) <= MISFIT


def _by_other_commands(
    learning: Learning, since: int, bound: float,
) -> Generator[None, None, Fitted | None]:
    """The fit of the commands that may have acted instead, where that explains the samples."""
    record, current = learning.record, learning.fit
    (v, y), others = learning.taken_since(record.first), record.others(record.first)
    result, found = yield from with_other_commands(
        current, v, y, others[:len(v)], learning.around._replace(walk=0.0), learning.pace
    )
    if result is current:
        return None
    newest = since - record.first
    unforeseen, known = (found.outliers | found.unknown)[newest:], np.isfinite(y[newest:])
    if learning.usable(result) is None or not _explains(result, newest, bound) \
            or np.count_nonzero(unforeseen) > OUTLIER_SHARE * np.count_nonzero(known):
        return None
    learning.believe(found, record.first)
    return result


def _best_of_all(
    learning: Learning, around: Around,
) -> Generator[None, None, Fitted | None]:
    """The most likely usable fit of the record by one plant."""
    current, pace = learning.fit, learning.pace
    v, y = learning.record.since(learning.record.first)
    results = []
    for beginning in learning.beginnings(around):
        result: Fitted | None
        if len(v) <= SEARCHED:
            result = yield from searched(v, y, beginning, learning.widest, pace)
        else:
            start = current.fit.start.with_gap(current.solution.gap, v)
            result = yield from fitted(
                v, y, beginning, start, current.solution.m, pace
            )
        if result is not None and result.keeps_prior and learning.usable(result) is not None:
            results.append(result)
    return most_likely(results) if results else None


def _has_changed(
    current: Fitted, newer: Fitted, whole: Fitted | None, before: bool = False,
) -> bool:
    """Whether two plants, the present fit and one of the newer samples, are more likely.

    Than one for the whole record. before: the newer one is of the whole record as well. Every
    unknown of the newer one costs half the logarithm of its samples (G. Schwarz, Estimating the
    dimension of a model, Annals of Statistics 6 (1978) 461-464).
    """
    if whole is None:
        return True
    fit = newer.fit
    unknowns = fit.layout.driven + newer.around.error.count
    told = newer.around.told_std / newer.solution.posterior.noise_std
    both = newer.evidence + log(told) + (0.0 if before else current.evidence)
    return both - 0.5 * unknowns * log(fit.length) > whole.evidence
