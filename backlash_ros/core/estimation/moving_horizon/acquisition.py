"""From nothing, or from what was inherited, to the first estimate."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.estimation.constants import (
    AS_GOOD,
    BLOCK,
    REPLACING,
    SEARCH_GROWTH,
    UNDECIDED,
)
from backlash_ros.core.estimation.fit.learned_error import plausible
from backlash_ros.core.estimation.fit.prior import contradicts, prior_of
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted, motionless, searched
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.moving_horizon.learning import Learning, Task
from backlash_ros.core.estimation.observer.record_attribution import (
    Attributed,
    as_told,
    with_other_commands,
)
from backlash_ros.core.estimation.regression.play import Start

Array = NDArray[np.float64]

TOLD = 1.0  # scale of the error of G that was told


def acquire(learning: Learning) -> Task:
    """Look for the backlash in the newest samples."""
    record, search = learning.record, learning.acquisition
    end = record.end
    first = max(record.first, end - learning.searched)
    v, y = record.since(first)
    waiting = search.one_sided if end < search.again_at and first == record.first else None
    one_sided = waiting is not None and not learning.reversed_often(waiting.labels(v))
    if one_sided or (
        search.inherited is None and end < UNDECIDED and not learning.may_have_reversed(v)
    ):
        search.next_at = end + BLOCK[0]
        return False
    search.next_at = search.again_at = end + max(int(len(record) * (SEARCH_GROWTH - 1.0)), BLOCK[0])
    search.one_sided = None
    record.forget_before(first)
    around = learning.free._replace(walk=learning.told_walk)
    found, commands = yield from searched_with_commands(learning, first, v, y, around)
    if search.inherited is not None:
        for begin in (0, len(v) // 2):
            kept = yield from confirmed(
                learning, v[begin:], y[begin:], search.inherited, found if begin == 0 else None
            )
            if kept is not None:
                learning.unconfirmed = True
                return learning.go_on_from(kept, first + begin)
        if found is None or learning.usable(found, REPLACING) is None:
            learning.reason = Status.INCONSISTENT
            return False
    before, search.candidate = search.candidate, None
    if found is None or learning.usable(found) is None:
        _explain(learning, found)
        return False
    # A first estimate has to be found twice: some samples alone may mislead.
    search.candidate = found.solution.of_theta
    search.next_at = end + BLOCK[0]
    again = before is not None and not contradicts(search.candidate, before)
    often = learning.reversed_often(found.fit)
    if again and found.decided and found.fit.reversals > 0 and often:
        learning.believe(commands, first)
        return learning.go_on_from(found, first)
    if again and not often and search.inherited is None:
        search.one_sided = found.fit.start
    return False


def searched_with_commands(
    learning: Learning, first: int, v: Array, y: Array, around: Around,
) -> Generator[None, None, tuple[Fitted | None, Attributed]]:
    """What a search finds in v (N,) and y (N,) from sample `first` on, and which commands acted."""
    found = yield from searched(v, y, around, learning.widest, learning.pace)
    if found is None:
        return None, as_told(v)
    others = learning.record.others(first)[:len(v)]
    return (yield from with_other_commands(found, v, y, others, found.around, learning.pace))


def confirmed(
    learning: Learning, v: Array, y: Array, inherited: Estimate, free: Fitted | None,
) -> Generator[None, None, Fitted | None]:
    """A fit with what was learned before; None where the samples contradict it.

    free: a fit without it, if there is one.
    """
    current, pace = learning.current, learning.pace
    # G is no worse known than it was: it does not explain whatever has happened.
    most = TOLD if current is None else current.solution.posterior.scale
    alone = learning.free._replace(most=most)
    kept = yield from fitted_around(learning, v, y, inherited, alone)
    gap, prior = inherited.c_r - inherited.c_l, kept.around.prior
    still = yield from motionless(v, y, alone, inherited.m, float(np.ptp(v)) + gap, pace)
    least = still.solution.rms
    if free is not None:
        usable = learning.usable(free, REPLACING) is not None
        if usable and prior is not None and contradicts(free.solution.of_theta, prior):
            return None
        least = min(least, free.solution.rms)
    good = kept.solution.rms <= AS_GOOD * least and plausible(kept.fit, kept.solution)
    return kept if good and kept.keeps_prior else None


def fitted_around(
    learning: Learning, v: Array, y: Array, known: Estimate, around: Around,
) -> Generator[None, None, Fitted]:
    """A fit with what was known before as the prior of `around`, and of where it begins."""
    prior = prior_of(known, learning.held if learning.around.inherited else None)
    gap = known.c_r - known.c_l
    start = Start(gap, float(v[0]) + 0.5 * gap)
    around = around._replace(prior=prior)
    return (yield from fitted(v, y, around, start, known.m, learning.pace))


def _explain(learning: Learning, result: Fitted | None) -> None:
    """Say why there is no estimate, where the samples should suffice for one."""
    if learning.record.end < UNDECIDED:
        return
    learning.acquisition.rejected = result
    if result is None:
        learning.reason = Status.NOT_EXCITED
        return
    inconsistent = result.solution.m < 0.0 or result.solution.moved_otherwise
    learning.reason = Status.INCONSISTENT if inconsistent else Status.ACQUIRING
