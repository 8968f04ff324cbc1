"""One function of a whole record: the backlash, the G of low order and the noise behind v and y.

The same fit as in the loop (relabelling.py), over all samples at once. For identification, for the
check of a driver, and for scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import (
    Fitted,
    fitted,
    most_likely,
    motionless,
    searched,
)
from backlash_ros.core.estimation.fit.solution import SMALLEST_NOISE, Around
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.estimation.whole_record.record_description import (
    BestFit,
    RecordFit,
    described,
    nothing,
    with_sign,
)
from backlash_ros.core.estimation.whole_record.record_samples import (
    SEARCHED_AT_MOST,
    busiest,
    check_record,
    outliers,
)
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

FEWEST = 10  # samples per unknown of G and u below which nothing is said


def fit_record(
    v: Array, y: Array, model: TransferFunction | StateModel, uncertainty: float,
    noise_std: float, bounds: Bounds | None = None, prior: Prior | None = None,
    delays: Sequence[int] = (0,),
) -> RecordFit:
    """Fit v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    model: G without delay of v. uncertainty: relative spread of its time constants, damping and
    delay, 0 where it is exact. noise_std: of y, a first guess. bounds: of m, c_r, c_l; without
    them any gap and sign may come out. prior: what is known of (m, m c_r, m c_l). delays: of v, in
    samples, of which the one with the largest evidence is taken. Raises ValueError for arrays that
    do not fit together or hold no numbers, and for delays that are none.
    """
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    if not delays or min(delays) < 0:
        raise ValueError(f'delays={delays!r} must name at least one, none of them negative')
    state = model if isinstance(model, StateModel) else StateModel(model)
    around = Around(
        build_error_model(state, uncertainty), max(noise_std, SMALLEST_NOISE), prior
    )
    widest = inf if bounds is None else bounds.c_r[1] - bounds.c_l[0]
    longest = max(delays)
    # y(k+1) follows v(k - delay); all delays are compared over the same samples of y.
    after = y[longest + 1:]
    swing = float(np.ptp(v)) if len(v) else 0.0
    if np.count_nonzero(np.isfinite(after)) < FEWEST * (state.order + 2):
        return nothing(state, nan, f'too few samples: {len(after)} after the longest delay')
    if swing == 0.0:
        return nothing(state, 0.0, 'v stood still')
    results: dict[int, BestFit] = {}
    for delay in delays:
        before = v[longest - delay:len(v) - 1 - delay]
        result = _fit(before, after, around, widest)
        if result is not None:
            results[delay] = result
    if not results:
        return nothing(state, 0.0, f'y shows nothing of v, which swung by {swing:.4g}')
    best = max(results, key=lambda delay: results[delay].found.evidence)
    margins = {
        delay: results[best].found.evidence - results[delay].found.evidence
        if delay in results else inf
        for delay in delays
    }
    before = v[longest - best:len(v) - 1 - best]
    return described(results[best], state, best, margins, bounds, before, after)


def _fit(v: Array, y: Array, around: Around, widest: float) -> BestFit | None:
    """Fit v (N,) and y (N,) after it; None where a constant u explains y as well."""
    found = _found(v, y, around, widest)
    sign = 1.0
    if found is not None and found.solution.m < 0.0 and around.prior is None:
        # With the other sign of G it is a fit like any other.
        sign, around = -1.0, _negated(around)
        found = _found(v, y, around, widest)
    if found is None:
        return None
    wild = _outliers(found)
    if wild.any():
        y = np.where(wild, nan, y)
        found = _again(v, y, found)
    still = drained(motionless(v, y, around, found.solution.m, float(np.ptp(v)), Pace()))
    return BestFit(found, sign, still, int(wild.sum()))


def _found(v: Array, y: Array, around: Around, widest: float) -> Fitted | None:
    if len(v) <= SEARCHED_AT_MOST:
        return drained(searched(v, y, around, widest, Pace()))
    part = busiest(v, y)
    found = drained(searched(v[part], y[part], around, widest, Pace()))
    if found is None:
        return None
    solution = found.solution
    gap = max(solution.gap, 0.0)
    # The play output at the start of the record may be anywhere in the gap.
    starts = [Start(gap, float(v[0]) + share * gap) for share in (0.0, 0.5, 1.0)]
    fits = [
        drained(fitted(v, y, found.around, start, solution.m, Pace())) for start in starts
    ]
    return most_likely(fits)


def _again(v: Array, y: Array, found: Fitted) -> Fitted:
    """The fit again, from where it stands, for other y."""
    return drained(
        fitted(v, y, found.around, found.beginning(v), found.solution.m, Pace())
    )


def _negated(around: Around) -> Around:
    model = StateModel(with_sign(around.model.transfer_function, -1.0))
    return around._replace(error=build_error_model(model, around.error.uncertainty))


def _outliers(result: Fitted) -> NDArray[np.bool_]:
    residual = result.fit.samples.residual(result.solution.posterior)
    # It is 0 where y was lost.
    return outliers(np.where(residual == 0.0, nan, residual), result.around.told_std)
