"""What a whole record says, G being roughly known: the backlash, a better G, the noise.

The same fit as in the loop, over all samples at once. For the check of a driver, and for scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan
from typing import NamedTuple

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

    nominal: TransferFunction
    model: TransferFunction
    evidence: float
    doubts: tuple[str, ...] = ()
    m: float = nan
    c_r: float = nan
    c_l: float = nan
    gap: float = nan
    std_m: float = nan
    std_c_r: float = nan
    std_c_l: float = nan
    std_gap: float = nan
    start: float = nan
    delay: int = 0
    margins: dict[int, float] = field(default_factory=dict)
    error_scale: float = nan
    noise_std: float = nan
    rms: float = nan
    correlation: float = nan
    unexplained: float = nan
    predicted: float = nan
    reversals: int = 0
    outliers: int = 0
    frequencies: tuple[float, float] = (nan, nan)

    @property
    def estimates(self) -> tuple[tuple[str, float, float], ...]:
        """Names, values and standard deviations of m, c_r, c_l."""
        return (('m', self.m, self.std_m), ('c_r', self.c_r, self.std_c_r),
                ('c_l', self.c_l, self.std_c_l))

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


class _Best(NamedTuple):
    """The best fit of a record. sign: of G in it. still: rms that a constant u leaves of y.
    evidence: log-likelihood by which the fit beats that."""

    problem: Problem
    fit: Fit
    sign: float
    still: float
    evidence: float
    outliers: int


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
    longest, swing = max(delays), float(np.ptp(v)) if len(v) else 0.0
    # y(k+1) follows v(k - delay); all delays are compared over the same samples of y.
    after = y[longest + 1:]
    if np.count_nonzero(np.isfinite(after)) < 10 * (nominal.order + 2):
        return RecordFit(
            nominal, nominal, nan, (f'too few samples: {len(after)} after the longest delay',))
    if swing == 0.0:
        return RecordFit(nominal, nominal, 0.0, ('v stood still',))
    found = {delay: best for delay in delays for best in [_best(
        v[longest - delay:len(v) - 1 - delay], after, nominal, uncertainty, noise_std,
    )] if best is not None}
    if not found:
        return RecordFit(
            nominal, nominal, 0.0, (f'y shows nothing of v, which swung by {swing:.4g}',))
    delay = max(found, key=lambda d: found[d].fit.evidence)
    best, margins = found[delay], {
        d: found[delay].fit.evidence - found[d].fit.evidence if d in found else inf
        for d in delays
    }
    fit, problem = best.fit, best.problem
    m, c_r, c_l = fit.crossings.tolist()
    std_m, std_c_r, std_c_l = fit.crossings_std.tolist()
    told = RecordFit(
        nominal, _learned(problem.family, fit, nominal, best.sign), best.evidence,
        m=best.sign * m, c_r=c_r, c_l=c_l, gap=fit.gap,
        std_m=std_m, std_c_r=std_c_r, std_c_l=std_c_l, std_gap=fit.gap_std,
        start=fit.p0, delay=delay, margins=margins, error_scale=fit.scale, noise_std=fit.noise,
        rms=fit.rms, correlation=fit.correlation, unexplained=fit.unexplained,
        predicted=1.0 - fit.rms / best.still if best.still > 0.0 else 0.0,
        reversals=_reversals(problem.input(fit)[0], fit), outliers=best.outliers,
        frequencies=frequencies_of(np.where(problem.known, problem.y, nan)),
    )
    return replace(told, doubts=_doubts(told, fit, bounds, swing))


def _best(
    v: Array, y: Array, nominal: TransferFunction, uncertainty: float, noise_std: float,
) -> _Best | None:
    """Fit v (N,) and y (N,) after it; None where a constant u explains y as well."""
    noise_std, wide = max(noise_std, SMALLEST_NOISE), (-1e300, 1e300)
    record = Record(0, v, y, np.full(len(v), nan))
    setup = Setup(
        PlantFamily(nominal, uncertainty), noise_std, Bounds((1e-300, 1e300), wide, wide), inf,
        float(np.ptp(v)), 0.0, np.zeros(3),
    )
    sign, fit = 1.0, afresh(setup, record)
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
    by_still = -0.5 * max(int(problem.known.sum()), 1) * float(
        np.log((still**2 + noise_std**2) / noise_std**2))
    return _Best(problem, fit, sign, still, fit.evidence - by_still, int(wild.sum()))


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


def _learned(
    family: PlantFamily, fit: Fit, nominal: TransferFunction, sign: float,
) -> TransferFunction:
    """The G of the fit where it is likelier than the nominal one."""
    if not family.count or fit.behind(np.zeros(family.count)) <= 1.0:
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
    ways = np.add.reduceat(moves, np.append(0, turns)) if len(moves) else moves
    ways = ways[np.abs(ways) > 5.0 * fit.gap_std]
    return int(np.count_nonzero(np.diff(np.sign(ways))))


def _doubts(
    found: RecordFit, fit: Fit, bounds: Bounds | None, swing: float,
) -> tuple[str, ...]:
    """What keeps it from being precise enough for the loop."""
    wanted = REVERSALS if len(fit.xi) else 1
    rest = f': {found.unexplained:.0%} of its motion follows from no backlash and no G' \
        if found.correlation > 0.0 and isfinite(found.unexplained) else ''
    return tuple(text for true, text in (
        (found.reversals < wanted,
         f'v crossed the gap {found.reversals} times; {wanted} at least are needed to tell both '
         'crossings'),
        (not found.std_m <= STD_SLOPE * abs(found.m), f'm is known to {found.std_m:.2g} only'),
        # A gap of 0 is known to 1 % of the swing.
        (not found.std_gap <= max(STD_GAP * found.gap, 0.01 * swing),
         f'the gap, about {found.gap:.4g}, is known to {found.std_gap:.2g} only{rest}'),
        *((far, f'{name} would be {value:.4g}, outside of its bounds')
          for (name, value, _), far in zip(
              found.estimates, outside_bounds(bounds, fit) if bounds else [False] * 3,
              strict=True)),
    ) if true)


def _with_sign(model: TransferFunction, sign: float) -> TransferFunction:
    """The same G, or with sign -1 its negative."""
    return TransferFunction((sign * model.numerator).tolist(), model.denominator.tolist())
