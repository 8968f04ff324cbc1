"""What a whole record says, G being roughly known: the backlash, a better G, the noise.

The same fit as in the loop, over all samples at once. For the check of a driver, and for scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.explanations import (
    SMALLEST_NOISE,
    Record,
    Setup,
    afresh,
    outside_bounds,
    problem_of,
)
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.estimation.settings import REVERSALS, STD_GAP, STD_SLOPE
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.records.samples import check_record, frequencies_of, outliers

Array = NDArray[np.float64]

FEWEST = 10  # samples per unknown of G and u below which nothing is said
SURE = 5.0  # standard deviations of the gap by which the play output must move to count
LIKELIER = 1.0  # log-likelihood by which another G than the nominal one must be better
NO_GAP = 0.01  # standard deviation of a gap over the swing of v that counts as known: there is none


@dataclass(frozen=True)
class RecordFit:
    """What a record says. u = m (p - c_r) with the play output p for the gap c_r - c_l.

    m [u/v] (negative where G has the wrong sign), c_r, c_l, gap [v] with honest standard deviations
    std_*: what G does not explain widens them. start: p before the first sample [v]. nominal: G as
    it was given. model: the G that was learned, the same where the data do not speak for another
    one; both without `delay` [samples]. margins: log-likelihood by which each of the delays that
    were compared falls behind it. error_scale: of the error of G, 1 where it is as large as the
    uncertainty says. noise_std: standard deviation of y, learned [y]. rms: of the residual [y].
    correlation: of successive residuals beyond chance. unexplained: motion of u that nothing
    explains, over m times the gap. evidence: log-likelihood by which the fit beats a constant u.
    predicted: share of the motion of y, beyond what a constant u explains, that it predicts.
    reversals: of the play output. outliers: samples that were left out. frequencies: between which
    y moves [rad/sample]. doubts: why the backlash is not known from this record, a sentence each.
    All numbers are nan where there is no fit.
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
    nominal: TransferFunction
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
        """|G_learned / G_nominal - 1| at frequencies (N,) [rad/sample], shape (N,).

        Without the gain at rest, which cannot be told from m.
        """
        z = np.exp(1j * np.asarray(frequencies, dtype=float))
        return np.asarray(np.abs(self.model.response(z) / self.nominal.response(z) - 1.0))


def fit_record(
    v: Array, y: Array, model: TransferFunction | StateModel, uncertainty: float,
    noise_std: float, bounds: Bounds | None = None, delays: Sequence[int] = (0,),
) -> RecordFit:
    """Fit v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    model: G without delay of v. uncertainty: relative spread of its time constants, damping and
    delay, 0 where it is exact. noise_std: of y, a first guess. bounds: of m, c_r, c_l; without
    them any gap and sign may come out. delays: of v, in samples, of which the one with the largest
    evidence is taken. Raises ValueError for arrays that do not fit together or hold no numbers, and
    for delays that are none.
    """
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    if not delays or min(delays) < 0:
        raise ValueError(f'delays={delays!r} must name at least one, none of them negative')
    nominal = model.transfer_function if isinstance(model, StateModel) else model
    longest = max(delays)
    # y(k+1) follows v(k - delay); all delays are compared over the same samples of y.
    after = y[longest + 1:]
    swing = float(np.ptp(v)) if len(v) else 0.0
    if np.count_nonzero(np.isfinite(after)) < FEWEST * (nominal.order + 2):
        return _nothing(nominal, nan, f'too few samples: {len(after)} after the longest delay')
    if swing == 0.0:
        return _nothing(nominal, 0.0, 'v stood still')
    results: dict[int, _Best] = {}
    for delay in delays:
        best = _best(v[longest - delay:len(v) - 1 - delay], after, nominal, uncertainty, noise_std)
        if best is not None:
            results[delay] = best
    if not results:
        return _nothing(nominal, 0.0, f'y shows nothing of v, which swung by {swing:.4g}')
    delay = max(results, key=lambda d: results[d].fit.evidence)
    margins = {
        d: results[delay].fit.evidence - results[d].fit.evidence if d in results else inf
        for d in delays
    }
    return _described(results[delay], nominal, delay, margins, bounds, swing)


@dataclass(frozen=True)
class _Best:
    """The best fit of a record. sign: of G in it. still: rms and evidence of a constant u."""

    setup: Setup
    problem: Problem
    fit: Fit
    sign: float
    still_rms: float
    still_evidence: float
    outliers: int


def _best(
    v: Array, y: Array, nominal: TransferFunction, uncertainty: float, noise_std: float,
) -> _Best | None:
    """Fit v (N,) and y (N,) after it; None where a constant u explains y as well."""
    sign, noise_std = 1.0, max(noise_std, SMALLEST_NOISE)
    wide = Bounds((1e-300, 1e300), (-1e300, 1e300), (-1e300, 1e300))
    record = Record(0, v, y, np.full(len(v), nan))
    setup = Setup(
        PlantFamily(nominal, uncertainty), noise_std, wide, inf, float(np.ptp(v)), 0.0, np.zeros(3)
    )
    fit = afresh(setup, record)
    if fit is not None and fit.m < 0.0:
        # With the other sign of G it is a fit like any other.
        sign = -1.0
        setup = replace(setup, family=PlantFamily(_with_sign(nominal, sign), uncertainty))
        fit = afresh(setup, record)
    if fit is None or not fit.valid:
        return None
    problem = problem_of(setup, record)
    wild = outliers(problem.residual(fit), noise_std)
    if wild.any():
        record = record._replace(y=np.where(wild, nan, y))
        problem = problem_of(setup, record)
        fit = afresh(setup, record, also=fit) or fit
    still = _still(problem, fit)
    count = max(int(problem.known.sum()), 1)
    still_evidence = -0.5 * count * float(np.log((still**2 + noise_std**2) / noise_std**2))
    return _Best(setup, problem, fit, sign, still, still_evidence, int(wild.sum()))


def _still(problem: Problem, fit: Fit) -> float:
    """RMS of what a constant u leaves of y."""
    flat = replace(fit, p0=float(problem.v.max()), theta=np.concatenate(
        [[fit.m, fit.theta[1], 2.0 * float(np.ptp(problem.v))], fit.theta[3:]]
    ))
    y = problem.y[problem.known]
    columns = problem.jacobian(flat)[problem.known]
    order = columns.shape[1] - 4 - problem.family.count
    chosen = columns[:, [*range(order), order + 2]]  # of X and o
    rest = y - chosen @ np.linalg.lstsq(chosen, y, rcond=1e-12)[0]
    return float(np.sqrt(np.mean(rest**2)))


def _described(
    best: _Best, nominal: TransferFunction, delay: int, margins: dict[int, float],
    bounds: Bounds | None, swing: float,
) -> RecordFit:
    """All there is to say about a fit."""
    fit, family = best.fit, best.setup.family
    m, c_r, c_l = fit.crossings.tolist()
    std_m, std_c_r, std_c_l = fit.crossings_std.tolist()
    p, _ = best.problem.input(fit)
    found = RecordFit(
        m=best.sign * m, c_r=c_r, c_l=c_l, gap=fit.gap,
        std_m=std_m, std_c_r=std_c_r, std_c_l=std_c_l, std_gap=fit.gap_std,
        start=fit.p0, nominal=nominal, model=_learned(family, fit, nominal, best.sign),
        delay=delay, margins=margins, error_scale=fit.scale, noise_std=fit.noise, rms=fit.rms,
        correlation=fit.correlation, unexplained=fit.unexplained,
        evidence=fit.evidence - best.still_evidence,
        predicted=1.0 - fit.rms / best.still_rms if best.still_rms > 0.0 else 0.0,
        reversals=_reversals(p, fit), outliers=best.outliers,
        frequencies=frequencies_of(np.where(best.problem.known, best.problem.y, nan)), doubts=(),
    )
    return _with_doubts(found, fit, bounds, swing, REVERSALS if family.count else 1)


def _learned(
    family: PlantFamily, fit: Fit, nominal: TransferFunction, sign: float,
) -> TransferFunction:
    """The G of the fit where it is likelier than the nominal one."""
    xi = fit.theta[3:]
    if not family.count:
        return nominal
    cov = fit.cov_xi + 1e-16 * np.eye(family.count)
    if 0.5 * float(xi @ np.linalg.solve(cov, xi)) <= LIKELIER:
        return nominal
    return _with_sign(family.model_at(fit.xi), sign)


def _reversals(p: Array, fit: Fit) -> int:
    """How often the play output p (N,) turned by more than the gap is uncertain.

    A side that is engaged without moving the play output, as one at the very start may be, tells
    nothing of its crossing.
    """
    moves = np.diff(p, prepend=fit.p0)
    moves = moves[moves != 0.0]
    turns = np.flatnonzero(np.diff(np.sign(moves))) + 1
    strokes = np.add.reduceat(moves, np.append(0, turns)) if len(moves) else moves
    strokes = strokes[np.abs(strokes) > SURE * fit.gap_std]
    return int(np.count_nonzero(np.diff(np.sign(strokes))))


def _with_doubts(
    found: RecordFit, fit: Fit, bounds: Bounds | None, swing: float, wanted: int,
) -> RecordFit:
    """The same with what keeps it from being precise enough for the loop."""
    doubts: list[str] = []
    if found.reversals < wanted:
        doubts.append(
            f'v crossed the gap {found.reversals} times; {wanted} at least are needed to tell both '
            'crossings'
        )
    if not found.std_m <= STD_SLOPE * abs(found.m):
        doubts.append(f'm is known to {found.std_m:.2g} only')
    if not found.std_gap <= max(STD_GAP * found.gap, NO_GAP * swing):
        doubts.append(
            f'the gap, about {found.gap:.4g}, is known to {found.std_gap:.2g} only'
            + (f': {found.unexplained:.0%} of its motion follows from no backlash and no G'
               if found.correlation > 0.0 and isfinite(found.unexplained) else '')
        )
    if bounds is not None:
        values = (found.m, found.c_r, found.c_l)
        doubts += [
            f'{name} would be {value:.4g}, outside of its bounds'
            for name, value, far in zip(
                ('m', 'c_r', 'c_l'), values, outside_bounds(bounds, fit), strict=True) if far
        ]
    return replace(found, doubts=tuple(doubts))


def _nothing(nominal: TransferFunction, evidence: float, reason: str) -> RecordFit:
    """No fit, and why."""
    return RecordFit(
        *(nan,) * 9, nominal, nominal, 0, {}, nan, nan, nan, nan, nan, evidence, nan, 0, 0,
        (nan, nan), (reason,),
    )


def _with_sign(model: TransferFunction, sign: float) -> TransferFunction:
    """The same G, or with sign -1 its negative."""
    return TransferFunction((sign * model.numerator).tolist(), model.denominator.tolist())
