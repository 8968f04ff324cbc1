"""What a whole record says, G being roughly known: the backlash, a better G, the noise.

The same fit as in the loop, over all samples at once. For the check of a driver, and for scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.explanations import (
    Setup,
    Window,
    afresh,
    outside_bounds,
    problem_of,
)
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.estimation.settings import REVERSALS, STD_GAP, STD_SLOPE
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.records.samples import check_record, outliers
from backlash_ros.core.simulation.metrics import turns

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordFit:
    """What a record says. u = m (p - c_r) with the play output p for the gap c_r - c_l.

    nominal: G as it was given. model: the G that was learned, the same where the data do not speak
    for another one; both without `delay` [samples]. doubts: why the backlash is not known from this
    record, a sentence each. fit: values and deviations, None where there is no fit, for a G of this
    sign. margins: log-likelihood by which each of the delays that were compared falls behind.
    predicted: share of the motion of y that it predicts. reversals: of the play output, by more
    than the gap is uncertain.
    """

    nominal: TransferFunction
    model: TransferFunction
    doubts: tuple[str, ...] = ()
    fit: WindowFit | None = None
    sign: float = 1.0
    delay: int = 0
    margins: dict[int, float] = field(default_factory=dict)
    predicted: float = nan
    reversals: int = 0

    @property
    def estimates(self) -> dict[str, tuple[float, float]]:
        """Values and standard deviations of m (negative where G has the wrong sign), c_r, c_l."""
        values, std = (nan, nan, nan), (nan, nan, nan)
        if self.fit is not None:
            values = (self.fit.crossings * [self.sign, 1.0, 1.0]).tolist()
            std = self.fit.crossings_std.tolist()
        return dict(zip(('m', 'c_r', 'c_l'), zip(values, std, strict=True), strict=True))

    @property
    def gap(self) -> float:
        """c_r - c_l, nan where there is no fit."""
        return nan if self.fit is None else self.fit.gap

    @property
    def std_gap(self) -> float:
        """Standard deviation of the gap: what G does not explain widens it."""
        return nan if self.fit is None else self.fit.gap_std

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is of no use to the loop: a wrong sign, and the doubts."""
        against = f'y moves against v: m would be {self.estimates["m"][0]:.4g}'
        return (against, *self.doubts) if self.sign < 0.0 else self.doubts

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
    them whatever is found counts. delays: of v [samples], of which the likeliest is taken. Raises
    ValueError for arrays that do not fit together or hold no numbers, and for delays that are none.
    """
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    if not delays or min(delays) < 0:
        raise ValueError(f'delays={delays!r} must name at least one, none of them negative')
    nominal = model.transfer_function if isinstance(model, StateModel) else model
    longest = max(delays)
    # y(k+1) follows v(k - delay); all delays are compared over the same samples of y.
    after = y[longest + 1:]
    few = np.count_nonzero(np.isfinite(after)) < 10 * (nominal.order + 2)
    found = [] if few or np.ptp(v) == 0.0 else [fit for delay in delays if (fit := _fitted(
        v[longest - delay:len(v) - 1 - delay], after, nominal, uncertainty, noise_std, bounds,
        delay))]
    if not found:
        why = f'too few samples: {len(after)} after the longest delay' if few \
            else 'v stood still' if np.ptp(v) == 0.0 \
            else f'y shows nothing of v, which swung by {np.ptp(v):.4g}'
        return RecordFit(nominal, nominal, (why,))
    evidence = {each.delay: each.fit.evidence for each in found if each.fit is not None}
    best = max(found, key=lambda each: evidence[each.delay])
    return replace(best, margins={
        delay: evidence[best.delay] - evidence.get(delay, -inf) for delay in delays})


def _fitted(
    v: Array, y: Array, nominal: TransferFunction, uncertainty: float, noise_std: float,
    bounds: Bounds | None, delay: int,
) -> RecordFit | None:
    """Fit v (N,) and y (N,) after it; None where a constant u explains y as well."""
    wide, swing = (-1e300, 1e300), float(np.ptp(v))
    record = Window(0, v, y, np.full(len(v), nan))
    for sign in (1.0, -1.0):
        family = PlantFamily(_times(nominal, sign), uncertainty)
        setup = Setup(family, noise_std, Bounds((1e-300, 1e300), wide, wide), inf, swing, 0.0,
                      np.zeros(3))
        fit = afresh(setup, record)
        if fit is None or fit.m > 0.0:
            break
    if fit is None or not fit.valid:
        return None
    problem = problem_of(setup, record)
    wild = outliers(problem.residual(fit), setup.noise_std)
    if wild.any():
        record = record._replace(y=np.where(wild, nan, y))
        problem, fit = problem_of(setup, record), afresh(setup, record, also=fit) or fit
    learned = nominal
    if family.count and fit.behind(np.zeros(family.count)) > 1.0:
        learned = _times(family.model_at(fit.xi), sign)
    p = np.append(fit.p0, problem.input(fit)[0])
    result = RecordFit(
        nominal, learned, fit=fit, sign=sign, delay=delay,
        predicted=1.0 - fit.left.rms / max(float(np.nanstd(record.y)), 1e-300),
        reversals=turns(p, 5.0 * fit.gap_std))
    wanted = REVERSALS if len(fit.xi) else 1
    rest = f': {fit.unexplained:.0%} of its motion follows from no backlash and no G' \
        if fit.left.correlation > 0.0 and isfinite(fit.unexplained) else ''
    std_m, beyond = float(fit.crossings_std[0]), outside_bounds(bounds, fit) if bounds else []
    return replace(result, doubts=tuple(text for true, text in (
        (result.reversals < wanted,
         f'v crossed the gap {result.reversals} times; {wanted} at least are needed to tell both '
         'crossings'),
        (not std_m <= STD_SLOPE * fit.m, f'm is known to {std_m:.2g} only'),
        # A gap of 0 is known to 1 % of the swing.
        (not fit.gap_std <= max(STD_GAP * fit.gap, 0.01 * swing),
         f'the gap, about {fit.gap:.4g}, is known to {fit.gap_std:.2g} only{rest}'),
        *((True, f'{out.name} would be {result.estimates[out.name][0]:.4g}, outside of its bounds')
          for out in beyond),
    ) if true))


def _times(model: TransferFunction, sign: float) -> TransferFunction:
    """The same G, or with sign -1 its negative."""
    return TransferFunction((sign * model.numerator).tolist(), model.denominator.tolist())
