"""How new samples come into the fit: block by block, and now and then by a refit of all."""

from __future__ import annotations

from collections.abc import Generator
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import (
    BEGINNING,
    BLOCK,
    LONGEST,
    MISFIT,
    MOVED,
    OUTLIER_SHARE,
    SEARCHED,
)
from backlash_ros.core.estimation.fit.arrival import arrival
from backlash_ros.core.estimation.fit.learned_error import strayed
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import (
    Fitted,
    fitted,
    labelled,
    most_likely,
    searched,
    with_other_gaps,
    with_walk,
)
from backlash_ros.core.estimation.fit.rounding.rounding import with_rounding
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.fit.window_fit import PAST
from backlash_ros.core.estimation.moving_horizon.change_detection import note_block
from backlash_ros.core.estimation.moving_horizon.learning import Learning, Task
from backlash_ros.core.estimation.observer.record_attribution import attributed
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.estimation.regression.readings import weights_of

Array = NDArray[np.float64]

AT_ONCE = 4  # largest blocks that are taken in at once, where there was no time before


def take_block(learning: Learning) -> Task:
    """Take in the samples that have come since the last block."""
    record, (fit, before, _) = learning.record, learning.fit
    number = record.first + fit.length
    v, y = record.since(number)
    v, y = v[:AT_ONCE * BLOCK[1]], y[:AT_ONCE * BLOCK[1]]
    doubted = record.doubted(number, len(y))
    rows = fit.columns(v, y)
    squares, outliers = fit.contradiction(rows, np.where(np.isnan(y), doubted, y), before)
    # The fit knows how little it knows; who follows the state from sample to sample does not.
    explained = np.isfinite(doubted) & ~outliers
    if explained.any():
        y[explained] = doubted[explained]
        record.restore((number + np.flatnonzero(explained)).tolist())
    record.decide_doubts(number + len(y))
    valid = np.isfinite(y)
    outliers &= valid
    if np.count_nonzero(outliers) <= OUTLIER_SHARE * np.count_nonzero(valid):
        valid &= ~outliers
        learning.leave_out(number, outliers)
    misfit = float(squares[valid].mean()) if valid.any() else 0.0
    fits = misfit <= MISFIT
    taken = np.where(valid & fits, y, nan)
    if fit.samples.rounding is not None:
        fit.samples.take_rounded(rows, taken, before.posterior)
    else:
        fit.samples.take(rows, taken, weights_of(y))
    yield
    note_block(learning, fits, number, squares)
    solution = fit.solve()
    learning.current = Fitted(fit, solution)
    learning.strayed = strayed(fit, solution) \
        or abs(solution.gap - fit.start.gap) > MOVED * solution.std_gap
    return fits


def refit(learning: Learning) -> Task:
    """Refit the whole record; a long one loses its oldest third first."""
    current = learning.fit
    yield from _attribute(learning, current)
    around, start, first = yield from _shortened(learning, current)
    v, y = learning.taken_since(first)
    start = start.with_gap(current.solution.gap, v)
    # The values of readings that tell intervals are only where these begin.
    fit = fitted if current.fit.samples.rounding is None else labelled
    result = yield from fit(v, y, around, start, current.solution.m, learning.pace)
    result = yield from with_walk(v, y, result, learning.pace)
    if len(v) <= SEARCHED:
        result = yield from _beside_other_gaps(learning, v, y, result)
    if not around.inherited:
        result = yield from with_rounding(v, y, result, learning.pace)
    return learning.go_on_from(result, first)


def _beside_other_gaps(
    learning: Learning, v: Array, y: Array, result: Fitted,
) -> Generator[None, None, Fitted]:
    """The fit of a short record, whose gap may be one of several."""
    prior = learning.around.prior
    if prior is not None:
        return (yield from with_other_gaps(v, y, result, prior, learning.pace))
    other = yield from searched(v, y, learning.around, learning.widest, learning.pace)
    if other is None:
        return result
    result = result.with_gap_spread(other.fit.gap_spread)
    return result if learning.usable(other) is None else most_likely([result, other])


def _shortened(
    learning: Learning, current: Fitted,
) -> Generator[None, None, tuple[Around, Start, int]]:
    """What to fit a record around that is not too long, its start and its first sample."""
    record, around = learning.record, learning.around
    fit, solution, _ = current
    if fit.length < LONGEST:
        if around.error.count:
            # Where the play began costs as many unknowns as the error of G has. What that did
            # has to die out as well.
            v, _ = learning.taken_since(record.first)
            gone = fit.start.forgotten_after(v) + PAST * around.model.memory
            if gone <= BEGINNING * len(v):
                return around, fit.start_after(v[:gone]), record.first + gone
        return around, fit.start, record.first
    gone = LONGEST // 3
    v, y = learning.taken_since(record.first)
    prior: Prior | None = None
    if around.inherited or (around.error.count == 0 and solution.correlation == 0.0):
        part = yield from fitted(v[:gone], y[:gone], around, fit.start, solution.m, learning.pace)
        known = arrival(part, current.contested)
        if known is not None:
            prior = learning.drifted(known, len(v) - gone)
    most = around.most if prior is not None and not around.inherited else inf
    around = around._replace(prior=prior, most=most)
    return around, fit.start_after(v[:gone]), record.first + gone


def _attribute(learning: Learning, current: Fitted) -> Generator[None, None, None]:
    """Let those v have acted over the record that its fit speaks for, and lose its outliers."""
    first = learning.record.first
    v, y = learning.taken_since(first)
    others = learning.record.others(first)[:len(v)]
    found = yield from attributed(current, v, y, others, learning.pace)
    learning.believe(found, first)
