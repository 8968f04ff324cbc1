"""Fits a backlash to a whole record with a roughly known G, by the same fit as in the loop."""

from collections.abc import Mapping, Sequence
from math import inf, nan
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation import explanations, settings
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.parameters import Bounds, Parameters
from backlash_ros.core.plant.numerics import std_of
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction
from backlash_ros.core.records.readings import check_record, outliers
from backlash_ros.core.simulation.run_record import turns
from backlash_ros.core.window import Window


class RecordFit(NamedTuple):
    """Result of fitting a record. nominal, model: G as given and as learned (the same unless the
    data favour another). doubts, against, outside: why the result is unusable: imprecise values, y
    moves against v, bounds violated. estimates: (value, standard deviation) of m (negative if y
    moves against v), c_r, c_l. fit: of -y if m is negative. predicted: share of the motion of y
    that is explained. reversals: of the play. margins: log-evidence that each delay is behind."""

    nominal: TransferFunction
    model: TransferFunction
    doubts: tuple[str, ...] = ()
    against: tuple[str, ...] = ()
    outside: tuple[str, ...] = ()
    estimates: Mapping[str, tuple[float, float]] = dict.fromkeys(('m', 'c_r', 'c_l'), (nan, nan))
    fit: WindowFit | None = None
    predicted: float = nan
    reversals: int = 0
    delay: int = 0
    margins: Mapping[int, float] = {}

    @property
    def gap(self) -> float:
        return self.fit.gap if self.fit else nan

    @property
    def std_gap(self) -> float:
        return self.fit.gap_std if self.fit else nan

    @property
    def reasons(self) -> tuple[str, ...]:
        return (*self.against, *self.doubts, *self.outside)

    @property
    def usable(self) -> bool:
        """Whether m, c_r and c_l are known well enough: there is no reason against it."""
        return not self.reasons

    def error_of_model(self, frequencies: Sequence[float]) -> Array:
        """|G_learned / G_nominal - 1| at frequencies (N,) [rad/sample]; both agree at rest."""
        z = np.exp(1j * np.asarray(frequencies, dtype=float))
        return np.asarray(np.abs(self.model.response(z) / self.nominal.response(z) - 1.0))


def fit_record(
    v: Array, y: Array, model: TransferFunction | StateModel, uncertainty: float,
    noise_std: float, bounds: Bounds | None = None, delays: Sequence[int] = (0,),
) -> RecordFit:
    """Fit a backlash and G to v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    model: G without the delay of v. uncertainty: relative std of its time constants, damping and
    delay, 0 if it is exact. noise_std: of y, a first guess. delays: candidates for the delay of v
    [samples]; the likeliest is taken. Raises ValueError for invalid arrays or delays.
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
    if few or np.ptp(v) == 0.0:
        why = f'too few samples: {len(after)} after the longest delay' if few else 'v stood still'
        return RecordFit(nominal, nominal, (why,))
    setup = explanations.Setup(PlantFamily(nominal, uncertainty), max(noise_std, 1e-12),
                               bounds or Parameters().estimator.bounds, inf, float(np.ptp(v)), 0.0,
                               np.zeros(3))
    fits = [_fitted(setup, v[longest - delay:len(v) - 1 - delay], after, bounds)._replace(
        delay=delay) for delay in delays]
    evidence = {each.delay: each.fit.evidence if each.fit else -inf for each in fits}
    best = max(fits, key=lambda each: evidence[each.delay])
    return best._replace(margins={
        delay: evidence[best.delay] - other for delay, other in evidence.items()})


def _fitted(setup: explanations.Setup, v: Array, y: Array, bounds: Bounds | None) -> RecordFit:
    """Fit v (N,) and the y (N,) after it, or -y if y moves against v."""
    family, swing = setup.family, float(np.ptp(v))
    record = Window(0, v, y, np.full(len(v), nan))
    fit, sign = explanations.afresh(setup, record), 1.0
    if fit is not None and fit.m < 0.0:
        record, sign = record._replace(y=-y), -1.0
        fit = explanations.afresh(setup, record)
    if fit is None or not fit.valid:
        why = f'y shows nothing of v, which swung by {swing:.4g}'
        return RecordFit(family.model, family.model, (why,))
    problem = setup.problem(record)
    wild = outliers(problem.residual(fit), setup.noise_std)
    if wild.any():
        record = record._replace(y=np.where(wild, nan, record.y))
        problem = setup.problem(record)
        fit = explanations.afresh(setup, record, also=fit) or fit
    reversals = turns(np.append(fit.p0, problem.at(fit).p), 5.0 * fit.gap_std)
    wanted = setup.turns_needed
    values, stds = (fit.crossings * [sign, 1.0, 1.0]).tolist(), std_of(fit.crossings_cov).tolist()
    doubts = {
        f'v crossed the gap {reversals} times; at least {wanted} are needed to identify both '
        'crossings': reversals < wanted,
        f'm is known only to ± {stds[0]:.2g}': not stds[0] <= settings.STD_SLOPE * fit.m,
        # Even a gap of 0 counts as known if its standard deviation is below 1 % of the swing.
        f'the gap, about {fit.gap:.4g}, is known only to ± {fit.gap_std:.2g}':
            not fit.gap_std <= max(settings.STD_GAP * fit.gap, 0.01 * swing),
    }
    outside = setup.outside_bounds(fit) if bounds else ()
    off = family.count and fit.behind(np.zeros(family.count)) > 1.0
    return RecordFit(
        family.model, family.model_at(fit.xi) if off else family.model,
        tuple(text for text, true in doubts.items() if true),
        (f'y moves against v: m would be {values[0]:.4g}',) if sign < 0.0 else (),
        tuple(f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]'
              for name, value, (low, high) in outside),
        dict(zip(('m', 'c_r', 'c_l'), zip(values, stds, strict=True), strict=True)),
        fit, 1.0 - fit.left.rms / max(float(np.nanstd(record.y)), 1e-300), reversals)
