"""What is said of a fit of a whole record, and why it may be of no use to the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.constants import PRECISE_SLOPE, REVERSALS
from backlash_ros.core.estimation.fit.crossings import crossings_of
from backlash_ros.core.estimation.fit.learned_error import as_told, likelier
from backlash_ros.core.estimation.fit.relabelling import Fitted
from backlash_ros.core.estimation.moving_horizon.acceptance import largest_gap_std, outside_bounds
from backlash_ros.core.estimation.regression.play import play
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

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


class BestFit(NamedTuple):
    """A fit of a record. sign: of G in it. still: the fit of a constant u. outliers: left out."""

    found: Fitted
    sign: float
    still: Fitted
    outliers: int


def described(
    result: BestFit, told: StateModel, delay: int, margins: dict[int, float],
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
    present = as_told(told, result.found.around.error.count)
    learned = likelier(fit, solution, present).model
    model = transfer if learned is told else with_sign(learned.transfer_function, sign)
    found = RecordFit(
        m=m, c_r=c_r, c_l=c_l, gap=c_r - c_l,
        std_m=stds[0], std_c_r=stds[1], std_c_l=stds[2], std_gap=stds[3],
        start=solution.start, told=transfer, model=model, delay=delay, margins=margins,
        error_scale=solution.posterior.scale, noise_std=solution.posterior.noise_std,
        rms=solution.rms, correlation=solution.correlation,
        unexplained=fit.unexplained(solution),
        evidence=result.found.evidence - result.still.evidence,
        predicted=1.0 - solution.rms / still if still > 0.0 else 0.0,
        reversals=_reversals(v, result.found), outliers=result.outliers,
        frequencies=frequencies_of(y), doubts=(),
    )
    uncertain = result.found.around.error.count > 0
    return _with_doubts(found, bounds, fit.swing, REVERSALS if uncertain else 1)


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
    found: RecordFit, bounds: Bounds | None, swing: float, wanted: int,
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
    if not found.std_gap <= largest_gap_std(found.gap, swing):
        doubts.append(
            f'the gap, about {found.gap:.4g}, is known to {found.std_gap:.2g} only'
            + (f': {found.unexplained:.0%} of its motion follows from no backlash and no G'
               if found.correlation > 0.0 and isfinite(found.unexplained) else '')
        )
    if bounds is not None:
        values = (found.m, found.c_r, found.c_l)
        stds = (found.std_m, found.std_c_r, found.std_c_l)
        outside = outside_bounds(values, stds, bounds)
        doubts += [
            f'{name} would be {value:.4g}, outside of its bounds'
            for name, value, far in zip(('m', 'c_r', 'c_l'), values, outside, strict=True) if far
        ]
    return replace(found, doubts=tuple(doubts))


def nothing(model: StateModel, evidence: float, reason: str) -> RecordFit:
    """No fit, and why."""
    transfer = model.transfer_function
    return RecordFit(
        *(nan,) * 9, transfer, transfer, 0, {}, nan, nan, nan, nan, nan, evidence, nan, 0, 0,
        (nan, nan), (reason,),
    )


def with_sign(model: TransferFunction, sign: float) -> TransferFunction:
    """The same G, or with sign -1 its negative."""
    return TransferFunction((sign * model.numerator).tolist(), model.denominator.tolist())


def frequencies_of(y: Array) -> tuple[float, float]:
    """Lowest and highest frequency between which y (N,) moves [rad/sample]; nan where lost."""
    known = np.flatnonzero(np.isfinite(y))
    filled = np.interp(np.arange(len(y)), known, y[known])
    moves = np.diff(filled)
    power = np.abs(np.fft.rfft((moves - moves.mean()) * np.hanning(len(moves)))) ** 2
    total = np.cumsum(power)
    low, high = np.searchsorted(total, np.array(MOTION) * total[-1]) * (2.0 * np.pi / len(moves))
    return float(low), float(high)
