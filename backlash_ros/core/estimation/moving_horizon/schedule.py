"""Which task of the fit is due.

    no estimate yet                    acquire      (acquisition.py)
    a block of new samples             take_block   (refitting.py)
    samples contradict the fit         reconsider   (change_detection.py)
    the record has grown, or gap or G
    have left those of the fit         refit        (refitting.py)
    the record contradicts itself      refit, and if that does not help halve (change_detection.py)
"""

from __future__ import annotations

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.constants import BLOCK, BLOCK_SHARE
from backlash_ros.core.estimation.moving_horizon.acquisition import acquire
from backlash_ros.core.estimation.moving_horizon.change_detection import halve, reconsider
from backlash_ros.core.estimation.moving_horizon.learning import Learning, Task
from backlash_ros.core.estimation.moving_horizon.refitting import refit, take_block


def next_task(learning: Learning, estimate: Estimate) -> Task | int:
    """What is to be done next, or the number of the sample before which nothing is.

    estimate: the published one.
    """
    end, current = learning.record.end, learning.current
    if current is None:
        next_at = learning.acquisition.next_at
        return acquire(learning) if end >= next_at else next_at
    fit, solution, _ = current
    length, contradicted = fit.length, learning.contradicted_from is not None
    fewest, most = BLOCK
    wanted = fewest if contradicted else min(max(length // BLOCK_SHARE, fewest), most)
    next_block = end - learning.waiting + wanted
    if end >= next_block:
        return take_block(learning)
    next_try = min(learning.next_try, next_block)
    if contradicted:
        return reconsider(learning, estimate) if end >= next_try else next_try
    if length >= learning.refit_at or (length >= learning.moved_at and learning.strayed):
        return refit(learning)
    if not (solution.correlation > 0.0 or learning.drifts_more(solution, length)):
        return next_block
    if end < next_try:
        return next_try
    # What contradicts may be a G that went astray: the plant has changed only where the best fit
    # of all says so.
    learning.refitted = bool(learning.around.error.count) and not learning.refitted
    return refit(learning) if learning.refitted else halve(learning)
