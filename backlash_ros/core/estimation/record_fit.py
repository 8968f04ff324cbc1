"""One function of a whole record: the backlash, the G of low order and the noise behind v and y.

The same fit as in the loop (relabelling.py), over all samples at once. For identification, for the
check of a driver, and for scripts.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, nan
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import (
    GATE,
    NO_GAP,
    PRECISE_GAP,
    PRECISE_SLOPE,
    REVERSALS,
    SMALLEST_NOISE,
)
from backlash_ros.core.estimation.crossings import crossings_of
from backlash_ros.core.estimation.error_model import build_error_model
from backlash_ros.core.estimation.pace import Pace
from backlash_ros.core.estimation.play import play
from backlash_ros.core.estimation.protocol import Bounds
from backlash_ros.core.estimation.relabelling import (
    Fitted,
    fitted,
    searched,
    with_better_model,
)
from backlash_ros.core.estimation.window_fit import Around, Prior, Start
from backlash_ros.core.state_model import StateModel
from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]
T = TypeVar('T')

FEWEST = 10  # samples per unknown of G and u below which nothing is said
SEARCHED_AT_MOST = 6000  # samples of a record that the search for the gap looks at
OUTLYING = 0.2  # share of the samples that may be outliers
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution with a median of |x| of 1
SURE = 5.0  # standard deviations of the gap by which the play output must move to count
MOTION = (0.1, 0.9)  # shares of the power of the moves of y below which its frequencies lie


@dataclass(frozen=True)
class RecordFit:
    """What a record says. u = m (p - c_r) with the play output p for the gap c_r - c_l.

    m [u/v] (negative where G has the wrong sign), c_r, c_l, gap [v] with honest standard deviations
    std_*: what G does not explain widens them. start: p before the first sample [v]. told: G as it
    was given. model: the G of low order that was learned, the same where the data do not speak for
    another one; both without `delay` [samples]. margins: log-likelihood by which each of the delays
    that were compared falls behind it. error_scale: of the error of G, 1 where it is as large as
    the uncertainty says. noise_std: deviation of y, learned [y]. rms: of the residual [y].
    correlation: of successive residuals beyond chance. unexplained: motion of u that nothing
    explains, over m times the gap. evidence: log-likelihood by which the fit beats a constant u.
    predicted: share of the motion of y, beyond what a constant u explains, that it predicts.
    reversals: of the play output. outliers: samples that were left out. frequencies:
    between which y moves [rad/sample]. doubts: why the backlash is not known from this record, a
    sentence each. All numbers are nan where there is no fit.
    """

    m: float
    c_r: float
    c_l: float
    gap: float
    std_m: float
    std_c_r: float
    std_c_l: float
    std_gap: float
    start: float
    told: TransferFunction
    model: TransferFunction
    delay: int
    margins: dict[int, float]
    error_scale: float
    noise_std: float
    rms: float
    correlation: float
    unexplained: float
    evidence: float
    predicted: float
    reversals: int
    outliers: int
    frequencies: tuple[float, float]
    doubts: tuple[str, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is of no use to the loop: the doubts, and a wrong sign."""
        if self.m < 0.0:
            return (f'y moves against v: m would be {self.m:.4g}', *self.doubts)
        return self.doubts

    @property
    def usable(self) -> bool:
        """Whether m, c_r and c_l are known as well as the loop wants to know them."""
        return not self.reasons

    def error_of_model(self, frequencies: Sequence[float]) -> Array:
        """|G_learned / G_told - 1| at frequencies (N,) [rad/sample], shape (N,).

        Without the gain at rest, which cannot be told from m.
        """
        z = np.exp(1j * np.asarray(frequencies, dtype=float))
        return np.asarray(np.abs(self.model.response(z) / self.told.response(z) - 1.0))


class _Result(NamedTuple):
    """A fit of a record. sign: of G in it. still: the fit of a constant u. outliers: left out."""

    found: Fitted
    around: Around
    sign: float
    still: Fitted
    outliers: int

    @property
    def evidence(self) -> float:
        """Log-likelihood."""
        return self.found.solution.posterior.evidence


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
    _check(v, y, delays)
    state = model if isinstance(model, StateModel) else StateModel(model)
    around = Around(
        state, build_error_model(state, uncertainty), max(noise_std, SMALLEST_NOISE), prior
    )
    widest = inf if bounds is None else bounds.c_r[1] - bounds.c_l[0]
    longest = max(delays)
    # y(k+1) follows v(k - delay); all delays are compared over the same samples of y.
    after = y[longest + 1:]
    swing = float(np.ptp(v)) if len(v) else 0.0
    if np.count_nonzero(np.isfinite(after)) < FEWEST * (state.order + 2):
        return _nothing(state, nan, f'too few samples: {len(after)} after the longest delay')
    if swing == 0.0:
        return _nothing(state, 0.0, 'v stood still')
    results: dict[int, _Result] = {}
    for delay in delays:
        before = v[longest - delay:len(v) - 1 - delay]
        result = _fit(before, after, around, widest)
        if result is not None:
            results[delay] = result
    if not results:
        return _nothing(state, 0.0, f'y shows nothing of v, which swung by {swing:.4g}')
    best = max(results, key=lambda delay: results[delay].evidence)
    margins = {
        delay: results[best].evidence - results[delay].evidence if delay in results else inf
        for delay in delays
    }
    before = v[longest - best:len(v) - 1 - best]
    return _described(results[best], state, best, margins, bounds, before, after)


def _check(v: Array, y: Array, delays: Sequence[int]) -> None:
    if v.ndim != 1 or v.shape != y.shape:
        raise ValueError(f'v {v.shape} and y {y.shape} must be of one length')
    if not np.isfinite(v).all():
        raise ValueError('v must be finite in every sample')
    if np.isinf(y).any():
        raise ValueError('y must be finite, or nan where it was lost')
    if not delays or min(delays) < 0:
        raise ValueError(f'delays={delays!r} must name at least one, none of them negative')


def drained(work: Generator[None, None, T]) -> T:
    """What a generator returns once all of its pieces are done."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            result: T = done.value
            return result


def _fit(v: Array, y: Array, around: Around, widest: float) -> _Result | None:
    """Fit v (N,) and y (N,) after it; None where a constant u explains y as well."""
    found = _found(v, y, around, widest)
    sign = 1.0
    if found is not None and found[0].solution.m < 0.0 and around.prior is None:
        # With the other sign of G it is a fit like any other.
        sign, around = -1.0, _negated(around)
        found = _found(v, y, around, widest)
    if found is None:
        return None
    result, moved = found
    wild = _outliers(result)
    if wild.any():
        y = np.where(wild, nan, y)
        result, moved = _refitted(v, y, moved, result)
    return _Result(result, moved, sign, _still(v, y, around, result), int(wild.sum()))


def _found(
    v: Array, y: Array, around: Around, widest: float,
) -> tuple[Fitted, Around] | None:
    if len(v) <= SEARCHED_AT_MOST:
        return drained(searched(v, y, around, widest, Pace()))
    part = _busiest(v)
    found = drained(searched(v[part], y[part], around, widest, Pace()))
    if found is None:
        return None
    result, moved = found
    solution = result.solution
    gap = max(solution.gap, 0.0)
    # The play output at the start of the record may be anywhere in the gap.
    fits = [
        drained(fitted(v, y, moved, Start(gap, float(v[0]) + share * gap), solution.m, Pace()))
        for share in (0.0, 0.5, 1.0)
    ]
    best = max(fits, key=lambda fit: fit.solution.posterior.evidence)
    return drained(with_better_model(v, y, moved, best, Pace()))


def _busiest(v: Array) -> slice:
    """The stretch for the search in which v moves most."""
    path = np.append(0.0, np.cumsum(np.abs(np.diff(v))))
    first = int(np.argmax(path[SEARCHED_AT_MOST - 1:] - path[:len(v) - SEARCHED_AT_MOST + 1]))
    return slice(first, first + SEARCHED_AT_MOST)


def _refitted(v: Array, y: Array, around: Around, result: Fitted) -> tuple[Fitted, Around]:
    """The fit again, from where it stands, for other y."""
    solution = result.solution
    start = result.fit.start._replace(p=solution.start).with_gap(solution.gap, v)
    again = drained(fitted(v, y, around, start, solution.m, Pace()))
    return drained(with_better_model(v, y, around, again, Pace()))


def _still(v: Array, y: Array, around: Around, result: Fitted) -> Fitted:
    """The fit of a constant u: of a gap wider than all of v."""
    swing = float(np.ptp(v))
    start = Start(3.0 * swing, float(v[0]) + 1.5 * swing)
    return drained(fitted(v, y, around, start, result.solution.m, Pace()))


def _negated(around: Around) -> Around:
    model = StateModel(_with_sign(around.model.transfer_function, -1.0))
    return around._replace(model=model, error=around.error.around(model))


def _with_sign(model: TransferFunction, sign: float) -> TransferFunction:
    return TransferFunction((sign * model.numerator).tolist(), model.denominator.tolist())


def _outliers(result: Fitted) -> NDArray[np.bool_]:
    """Readings that are none, by the bulk of the residuals; none at all where they are many."""
    residual = np.abs(result.fit.residual(result.solution.posterior))
    known = residual[residual > 0.0]
    typical = NORMAL_MAD * float(np.median(known)) if len(known) else 0.0
    wild = residual > GATE * max(typical, result.fit.around.told_std)
    return wild if np.count_nonzero(wild) <= OUTLYING * len(known) else np.zeros_like(wild)


def _described(
    result: _Result, told: StateModel, delay: int, margins: dict[int, float],
    bounds: Bounds | None, v: Array, y: Array,
) -> RecordFit:
    """All there is to say about a fit of v (N,) and y (N,)."""
    fit, solution, _ = result.found
    sign = result.sign
    theta = sign * solution.theta
    # theta / m has the same crossings and deviations for both signs.
    crossings = crossings_of(np.copysign(1.0, theta[0]) * theta, solution.theta_cov)
    m = float(theta[0])
    c_r, c_l, stds = nan, nan, (nan, nan, nan, nan)
    if crossings is not None:
        c_r, c_l = crossings.c_r, crossings.c_l
        stds = (crossings.std_m, crossings.std_c_r, crossings.std_c_l, crossings.std_gap)
    still = result.still.solution.rms
    transfer = told.transfer_function
    learned = result.around.model
    model = transfer if learned.transfer_function is transfer \
        else _with_sign(learned.transfer_function, sign)
    found = RecordFit(
        m=m, c_r=c_r, c_l=c_l, gap=c_r - c_l,
        std_m=stds[0], std_c_r=stds[1], std_c_l=stds[2], std_gap=stds[3],
        start=solution.start, told=transfer, model=model, delay=delay, margins=margins,
        error_scale=solution.posterior.scale, noise_std=solution.posterior.noise_std,
        rms=solution.rms, correlation=solution.correlation,
        unexplained=fit.unexplained(solution),
        evidence=result.evidence - result.still.solution.posterior.evidence,
        predicted=1.0 - solution.rms / still if still > 0.0 else 0.0,
        reversals=_reversals(v, result.found), outliers=result.outliers,
        frequencies=frequencies_of(y), doubts=(),
    )
    uncertain = result.around.error.count > 0
    return _with_doubts(found, bounds, NO_GAP * fit.swing, REVERSALS if uncertain else 1)


def _reversals(v: Array, found: Fitted) -> int:
    """How often the play output turned by more than the gap is uncertain.

    A side that is engaged without moving the play output, as one at the very start may be, tells
    nothing of its crossing.
    """
    start = found.fit.start
    moves = np.diff(play(v, start.gap, start.p)[0], prepend=start.p)
    moves = moves[moves != 0.0]
    turns = np.flatnonzero(np.diff(np.sign(moves))) + 1
    strokes = np.add.reduceat(moves, np.append(0, turns)) if len(moves) else moves
    strokes = strokes[np.abs(strokes) > SURE * found.solution.std_gap]
    return int(np.count_nonzero(np.diff(np.sign(strokes))))


def _with_doubts(
    found: RecordFit, bounds: Bounds | None, no_gap: float, wanted: int,
) -> RecordFit:
    """The same with what keeps it from being precise enough for the loop."""
    doubts: list[str] = []
    if found.reversals < wanted:
        doubts.append(
            f'v crossed the gap {found.reversals} times; {wanted} at least are needed to tell both '
            'crossings'
        )
    if not found.std_m <= PRECISE_SLOPE * abs(found.m):
        doubts.append(f'm is known to {found.std_m:.2g} only')
    if not found.std_gap <= max(PRECISE_GAP * found.gap, no_gap):
        doubts.append(
            f'the gap, about {found.gap:.4g}, is known to {found.std_gap:.2g} only'
            + (f': {found.unexplained:.0%} of its motion follows from no backlash and no G'
               if found.correlation > 0.0 and isfinite(found.unexplained) else '')
        )
    if bounds is not None:
        values = (found.m, found.c_r, found.c_l)
        stds = (found.std_m, found.std_c_r, found.std_c_l)
        inside = bounds.project(*values)
        doubts += [
            f'{name} would be {value:.4g}, outside of its bounds'
            for name, value, std, near in zip(
                ('m', 'c_r', 'c_l'), values, stds, inside, strict=True
            ) if abs(value - near) > 3.0 * std + 1e-9 * abs(near)
        ]
    return replace(found, doubts=tuple(doubts))


def _nothing(model: StateModel, evidence: float, reason: str) -> RecordFit:
    """No fit, and why."""
    transfer = model.transfer_function
    return RecordFit(
        *(nan,) * 9, transfer, transfer, 0, {}, nan, nan, nan, nan, nan, evidence, nan, 0, 0,
        (nan, nan), (reason,),
    )


def frequencies_of(y: Array) -> tuple[float, float]:
    """Lowest and highest frequency between which y (N,) moves [rad/sample]; nan where lost."""
    known = np.flatnonzero(np.isfinite(y))
    filled = np.interp(np.arange(len(y)), known, y[known])
    moves = np.diff(filled)
    power = np.abs(np.fft.rfft((moves - moves.mean()) * np.hanning(len(moves)))) ** 2
    total = np.cumsum(power)
    low, high = np.searchsorted(total, np.array(MOTION) * total[-1]) * (2.0 * np.pi / len(moves))
    return float(low), float(high)
