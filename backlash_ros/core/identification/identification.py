"""From v and y to backlash, G(z), delay and noise, with deviations and all that keeps them apart.

    search the gap with a general G  ->  compare orders, delays, integrators on held-out samples
    ->  search the gap again with the one that is taken  ->  deviations, judgement

Search and fit are those of the loop, for plants without a prior (structure.py).
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from math import exp, inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.deviations import covariance_of, ljung_box
from backlash_ros.core.estimation.explanations import begun_elsewhere
from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS
from backlash_ros.core.estimation.reading import step_of
from backlash_ros.core.estimation.search import search
from backlash_ros.core.estimation.settings import ROWS
from backlash_ros.core.identification.not_play import Observed, what_it_is
from backlash_ros.core.identification.order_selection import (
    PLATEAU,
    Compared,
    cancelled_poles,
    compare,
    effective,
    eligible,
    equal_delays,
    gives_way,
    lag_one,
    predicted,
    selected,
)
from backlash_ros.core.identification.response import Response, least_response, response_of
from backlash_ros.core.identification.structure import (
    TINY,
    VAGUE,
    Model,
    Samples,
    Structure,
    first_model,
    fitted,
    moved_to,
)
from backlash_ros.core.identification.verdict import ANOTHER, CERTAIN, Findings, Verdict, judge
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.roughness import noise_of
from backlash_ros.core.records.samples import busiest, check_record, frequencies_of, outliers

Array = NDArray[np.float64]

POLES = 3  # of the general G with which the gap is searched first; it has a tap for each delay
EARLY, LONGEST_DELAY = (0, 1, 2, 3), 40  # delays that are compared first, and the longest
ALIKE = 5.0  # log-likelihood by which a delay that fits alike may be worse
SMALLEST_GAP = 2e-3  # that is searched for, over the swing of v


@dataclass(frozen=True)
class Options:
    """What is compared. delays [samples]: none for EARLY, and later ones where these fit better.
    integrators: of G, without and with one. slope: m, where it is known, else 1: m and the gain of
    G cannot be told apart. held_out: share of the record, its last."""

    orders: Sequence[int] = (0, 1, 2, 3, 4)
    delays: Sequence[int] = ()
    integrators: Sequence[bool] = (False, True)
    slope: float = 1.0
    held_out: float = 1.0 / 3.0


class HeldOut(NamedTuple):
    """Prediction of samples that were not fitted. first: number of the first of them; measured,
    simulated (M,); rms of the error; trained: rms of the fit to the samples before."""

    first: int
    measured: Array
    simulated: Array
    rms: float
    trained: float


class Details(NamedTuple):
    """What pictures show, in units of the record.

    first: number of the first y that was fitted; v, y, p, simulated: of each y from there on, v and
    p as they act on it. profile: gaps (G,), and the rms that G refitted to first order leaves.
    """

    first: int
    v: Array
    y: Array
    p: Array
    simulated: Array
    response: Response
    compared: tuple[Compared, ...]
    chosen: Compared
    profile: tuple[Array, Array]
    held_out: HeldOut

    @property
    def residual(self) -> Array:
        """y less what is simulated, nan where lost."""
        return np.asarray(self.y - self.simulated)


@dataclass(frozen=True)
class Identification:
    """What was found. u = m (p - c_r), y = z^-delay numerator / denominator u + noise.

    std: deviations of gap, c_r, c_l and, for m, of the product of m and the gain of G. delays: that
    explain y equally well. quantum: step of a quantised y, 0 for none. correlation: of successive
    residuals beyond chance. ljung_box: probability of a white residual. response_std: relative
    deviation of G at `frequencies` [rad/sample], between which y moves. uncertainty: of G, as the
    parameter plant.uncertainty. outliers: samples of y that were left out. reasons: why it is of no
    use, remarks: what to know, a sentence each. details, verdict: None where nothing was fitted.
    actuator: between the command and v; None where nothing is, or it is not known.
    """

    sample_period: float
    v: Array
    y: Array
    m: float = nan
    gap: float = nan
    c_r: float = nan
    c_l: float = nan
    std: dict[str, float] = field(default_factory=dict)
    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    delay: int = 0
    delays: tuple[int, ...] = ()
    integrator: bool = False
    noise_std: float = nan
    quantum: float = 0.0
    correlation: float = nan
    ljung_box: float = nan
    frequencies: Array = field(default_factory=lambda: np.empty(0))
    response_std: Array = field(default_factory=lambda: np.empty(0))
    uncertainty: float = nan
    outliers: int = 0
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    details: Details | None = None
    verdict: Verdict | None = None
    actuator: Actuator | None = None

    @property
    def usable(self) -> bool:
        """Whether it may be put into the controller."""
        return not self.reasons


class _Units(NamedTuple):
    """Middle and size of v and of y, by which both are centred and scaled."""

    v: float
    v_size: float
    y: float
    y_size: float


AS_SCALED = _Units(0.0, 1.0, 0.0, 1.0)


class _Search(NamedTuple):
    """The best of the structures that were compared, in scaled units.

    rivals: other minima (gap, how far behind). profile: gaps, and their rms. apart: deviation of
    the gap beside the fit's, by a model or a delay that fits alike.
    """

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Model
    rivals: list[tuple[float, float]]
    profile: tuple[Array, Array]
    held_out: HeldOut
    delays: Sequence[int]
    apart: float = 0.0


def identify(v: Array, y: Array, sample_period: float, options: Options | None = None,
             ) -> Identification:
    """Identify v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    Raises ValueError for arrays that do not fit together or hold what is no number.
    """
    work = identifying(v, y, sample_period, options or Options())
    while True:
        try:
            next(work)
        except StopIteration as done:
            found: Identification = done.value
            return found


def identifying(
    v: Array, y: Array, sample_period: float, options: Options,
) -> Generator[str, None, Identification]:
    """The same; yields what is being done."""
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    given, part = Identification(sample_period, v, y), busiest(v, y)
    nothing = _why_nothing(v, y[part], options)
    if nothing:
        return replace(given, reasons=(nothing,))
    units = _Units(float(v.mean()), float(np.ptp(v[part])), float(np.nanmedian(y)),
                   float(np.nanstd(y[part])))
    v, y = (v - units.v) / units.v_size, (y - units.y) / units.y_size
    s = yield from _searched(v[part], y[part], options, options.delays or EARLY)
    if not options.delays:
        s = yield from _later(s, options)
    yield 'choosing the delay'
    best, rows = s.best, effective(s.best.left)
    others = [
        fitted(s.samples, structure, moved_to(structure, best))
        for delay in equal_delays(s.compared, s.chosen) if delay != best.structure.delay
        for structure in [replace(best.structure, delay=delay)]
    ]
    # With as many poles, some of them may fit worse.
    best, beside = least_response(s.samples, best, [
        one for one in others if rows * log(max(one.squares, TINY) / max(best.squares, TINY))
        <= PLATEAU
    ], best.squares / rows)
    samples = s.samples
    if len(v) > len(samples.v):
        yield 'fitting the whole record'
        whole = y.copy()
        whole[part] = samples.y
        samples = replace(samples, v=v, y=whole, last=len(v))
        begin = moved_to(best.structure, best, p0=float(v[0]) + 0.5 * best.gap)
        best = _begun(fitted(samples, best.structure, begin, FIRST_STEPS, beside))
        kept = _without_outliers(samples, best)
        if kept is not samples:
            samples = kept
            best = fitted(samples, best.structure, best.fit, beside=beside)
    yield 'judging'
    given = replace(given, outliers=int((np.isfinite(given.y) & np.isnan(samples.y)).sum()))
    s = s._replace(samples=samples, best=best, held_out=s.held_out._replace(
        first=part.start + s.held_out.first))
    found = _described(s, given, options, units)
    return _as_a_gain(found, s, given, options, units)


def _why_nothing(v: Array, y: Array, options: Options) -> str:
    """Why there is nothing to fit; empty where there is. y: of the part that is searched."""
    known = np.isfinite(y[max(options.delays or EARLY) + 1:])
    # The first samples of them are fitted alone, to predict the others.
    fitted = known[:len(known) - round(options.held_out * len(known))]
    needed = 8 * max(Structure(max(options.orders), 0, False).unknowns,
                          Structure(POLES, 0, False).unknowns)
    if fitted.sum() < needed or not known[len(fitted):].any():
        return (
            f'{int(known.sum())} samples of y are too few, or lie too unevenly, for an order of up '
            f'to {max(options.orders)}, about {round(needed / (1.0 - options.held_out))} are '
            'needed: record for longer, or limit --order'
        )
    if np.ptp(v) == 0.0:
        return 'v stood still: move it to and fro, past the gap'
    if np.nanmax(y) == np.nanmin(y):
        return 'y stood still: let v swing wider than the gap, and see that y is measured'
    return ''


def _searched(
    v: Array, y: Array, options: Options, delays: Sequence[int], step: float | None = None,
) -> Generator[str, None, _Search]:
    """The best structure with one of these delays. step: of the readings, None: told from them."""
    far_off = 0.03  # relative distance of the last gap from the first, with which to begin anew
    yield 'searching the gap'
    samples = Samples(v, y, max(delays) + 1, len(v), step_of(y) if step is None else step)
    cut = samples.last - round(options.held_out * samples.count)
    found = _with_general(samples, delays)
    kept = _without_outliers(samples, found[0])
    if kept is not samples:
        samples = kept
        found = _with_general(samples, delays)
    candidates = found[:2]
    structures = [
        Structure(order, delay, integrator) for integrator in options.integrators
        for delay in delays for order in options.orders if order >= integrator
    ]
    for again in (True, False):
        yield 'comparing orders and delays'
        compared = compare(samples, candidates, structures, cut)
        yield 'refining'
        for _ in structures:
            chosen = selected(compared)
            models, profile = _of_gaps(samples, chosen.whole)
            best = _begun(models[0])
            if not gives_way(best, eligible(compared)):
                break
            # Only the best fit of all shows that a pole is none.
            compared = [one._replace(whole=best) if one is chosen else one for one in compared]
        if not again or abs(best.gap - candidates[0].gap) <= far_off * best.gap:
            break
        candidates = [best, candidates[0]]  # the general G may have been a poor one
    if best.rms > samples.step > 0.0:  # rounding is the least of what is left
        return (yield from _searched(v, y, options, delays, 0.0))
    rows = effective(best.left)
    rivals = sorted(
        (0.5 * rows * log(max(one.squares, TINY) / max(best.squares, TINY)), one.gap)
        for one in models if abs(one.gap - best.gap) > ANOTHER * best.gap
    )
    held_out = HeldOut(
        cut, samples.y[cut:samples.last], predicted(chosen.trained, replace(samples, first=cut)),
        chosen.held_out, chosen.trained.rms)
    return _Search(samples, compared, chosen, best, [(gap, behind) for behind, gap in rivals],
                   (profile[0], best.rms * profile[1]), held_out, delays)


def _with_general(samples: Samples, delays: Sequence[int]) -> list[Model]:
    """Models of different gaps, the best first, with a few poles and a tap for each delay."""
    general = Structure(POLES, min(delays), False, POLES + max(delays) - min(delays))
    swing = float(np.ptp(samples.v))
    begins = sorted((
        first_model(samples, general, gap, float(samples.v[0]) + 0.5 * gap)
        for gap in (0.0, 0.05 * swing, 0.2 * swing, 0.5 * swing)
    ), key=lambda one: one.squares)
    rough = [fitted(samples, general, one.fit, FEW_STEPS) for one in begins[:2]]
    best = min(rough, key=lambda one: one.squares)
    for _ in range(2):
        models, _ = _of_gaps(samples, best)
        if models[0].squares > 0.9 * best.squares:
            break
        best = models[0]
    return models


def _of_gaps(samples: Samples, like: Model) -> tuple[list[Model], tuple[Array, Array]]:
    """Fits of the same structure to the minima over the gap, the best first; the profile."""
    most, apart = 4, 0.005  # minima that are fitted, and the relative distance of different ones
    structure, problem = like.structure, like.problem
    y = np.where(problem.known, problem.y, nan)
    swing = float(np.ptp(problem.v))
    hypotheses, _ = search(structure, problem.v, y, 1e-12, 0.98 * swing,
                           like.fit.theta[3:], True, SMALLEST_GAP)
    begins, gaps = [like.fit], [like.gap]
    for _, gap, p0, _ in hypotheses:
        if len(begins) <= most and all(abs(gap - other) > ANOTHER * other for other in gaps):
            gaps.append(gap)
            begins.append(problem.step(moved_to(structure, like, gap, p0), held=True))
    some = sorted((fitted(samples, structure, begin, FIRST_STEPS) for begin in begins),
                  key=lambda one: one.squares)
    models: list[Model] = []
    for one in some:
        model = one if one.squares > 1.5 * some[0].squares else fitted(samples, structure, one.fit)
        if all(abs(model.gap - other.gap) > apart * other.gap for other in models):
            models.append(model)
    models.sort(key=lambda one: one.squares)
    by_gap: dict[float, float] = {}
    for h in hypotheses:
        by_gap[h.gap] = max(h.evidence, by_gap.get(h.gap, -inf))
    curve = np.array(sorted(by_gap.items())).reshape(-1, 2)
    behind = curve[:, 1].max(initial=-inf) - curve[:, 1]
    return models, (curve[:, 0], np.exp(behind / min(len(problem.v), ROWS)))


def _begun(found: Model) -> Model:
    """The model, or one whose play began elsewhere."""
    return replace(found, fit=begun_elsewhere(found.problem, found.fit))


def _without_outliers(samples: Samples, found: Model) -> Samples:
    """The same without readings that are none; rounding makes none."""
    wild = outliers(found.residual, quantum(samples.fitted_y()))
    if not wild.any():
        return samples
    y = samples.y.copy()
    y[samples.first:samples.last][wild] = nan
    return replace(samples, y=y)


def _later(early: _Search, options: Options) -> Generator[str, None, _Search]:
    """The search among later delays, where one of them explains y as well or better.

    The same structure is fitted with one sample of delay more and more, from the fit before.
    """
    most_alike = 8  # delays that fit alike, beyond which none of them is told
    worse_for = 3  # delays in a row that fit worse, behind which no later one is tried
    yield 'searching later delays'
    best, latest = early.best, min(LONGEST_DELAY, len(early.samples.v) // 20)
    samples = replace(early.samples, first=latest + 1)
    scan = [fitted(samples, best.structure, best.fit)]
    alike, rows = list(scan), effective(scan[0].left)
    while scan[-1].structure.delay < min(latest, alike[-1].structure.delay + worse_for):
        before = scan[-1]
        structure = replace(best.structure, delay=before.structure.delay + 1)
        begins = [moved_to(structure, before), first_model(
            samples, structure, before.gap, before.fit.p0, (0.6,)).fit]
        scan.append(min((fitted(samples, structure, begin, FIRST_STEPS) for begin in begins),
                        key=lambda one: one.squares))
        most = min(one.squares for one in scan) * exp(2.0 * ALIKE / rows)
        alike = [one for one in scan if one.squares <= most]
    first, last = (alike[k].structure.delay for k in (0, -1))
    if last <= EARLY[-1]:
        return early
    # Their mixture.
    share = np.array([one.squares for one in alike])
    share = (share.min() / share) ** (0.5 * rows)
    off = np.array([one.gap - best.gap for one in alike])
    early = early._replace(apart=sqrt(float(share @ off**2) / float(share.sum())))
    # What no G with a backlash explains, any delay explains a little better.
    other = what_it_is(_observed(early.samples, best))
    if last - first > most_alike or (other is not None and not other.known):
        return early
    late = yield from _searched(early.samples.v, early.samples.y, options, range(
        max(first - 1, 0), min(last + 2, latest) + 1))
    better = effective(late.best.left) * log(max(best.rms, TINY) / max(late.best.rms, TINY))
    return late if late.best.structure.delay < max(late.delays) and better > -ALIKE else early


def _delay_open(samples: Samples, best: Model) -> bool:
    """Whether one more sample of delay fits as well."""
    samples = replace(samples, first=samples.first + 1)
    longer = replace(best.structure, delay=best.structure.delay + 1)
    this, other = (fitted(samples, structure, moved_to(structure, best))
                   for structure in (best.structure, longer))
    ratio = log(max(other.squares, TINY) / max(this.squares, TINY))
    return bool(best.structure.delay) and effective(this.left) * ratio < PLATEAU


def _observed(
    samples: Samples, best: Model, units: _Units = AS_SCALED,
) -> Observed:
    """The signals of a fit; v at the same samples as y."""
    v0, v_size, y0, y_size = units
    problem = best.problem
    y = np.where(problem.known, problem.y, nan)
    noise = noise_of(np.flatnonzero(problem.known).astype(float), y[problem.known])
    noise = max(noise, quantum(y) / sqrt(12.0))
    v = samples.v[samples.first:samples.last]
    return Observed(v0 + v_size * v, y0 + y_size * y, v0 + v_size * best.p,
                    y0 + y_size * best.simulated, y_size * noise, v_size * best.gap)


def _crossings(best: Model, covariance: Array, units: _Units) -> tuple[float, Array]:
    """c_r, and the covariance of (gap, c_r), shape (2, 2)."""
    taps = best.structure.numerator_taps
    b, a = float(best.numerator.sum()), 1.0 + float(best.a.sum())
    # Unless G integrates, the middle of y is part of the offset.
    shift = 0.0 if best.structure.integrator or not b else units.y / units.y_size * a / b
    c_r = units.v + units.v_size * (float(best.fit.theta[1]) - shift)
    jacobian = np.zeros((2, len(covariance)))
    jacobian[0, 2] = jacobian[1, 1] = units.v_size
    jacobian[1, 3:3 + taps] = VAGUE * units.v_size * shift / b if b else 0.0
    jacobian[1, 3 + taps:] = -VAGUE * units.v_size * shift / a if a else 0.0
    return c_r, np.asarray(jacobian @ covariance @ jacobian.T)


def _described(
    s: _Search, given: Identification, options: Options, units: _Units,
) -> Identification:
    """Everything there is to say of the best fit."""
    best, chosen, structure = s.best, s.chosen, s.best.structure
    covariance = covariance_of(best.problem, best.fit)
    c_r, crossings = _crossings(best, covariance, units)
    gap, apart = units.v_size * best.gap, units.v_size * s.apart
    gap_var, c_r_var = np.diag(crossings).tolist()
    c_l_var = max(gap_var + c_r_var - 2.0 * float(crossings[0, 1]), 0.0)
    gap_var += apart**2
    g = response_of(best, covariance, units.y_size / units.v_size)
    low, high = frequencies_of(best.simulated)
    low = max(low, np.pi / len(best.simulated))
    frequencies = np.geomspace(low, max(high, 1.01 * low), 60, dtype=np.float64)
    spread, gain_std = g.std(frequencies), float(g.std(np.zeros(1))[0])
    middle = np.sqrt(frequencies[:1] * frequencies[-1:])
    residual, squares, still = best.left, best.squares, _still(best)
    first, measured, simulated, rms, trained = s.held_out
    held_out = HeldOut(first, units.y + units.y_size * measured,
                       units.y + units.y_size * simulated, units.y_size * rms,
                       units.y_size * trained)
    delays = tuple(sorted({*equal_delays(s.compared, chosen), structure.delay}))
    correlation = max(lag_one(residual) - 3.0 / sqrt(len(residual)), 0.0)
    observed = _observed(s.samples, best, units)
    step, total = quantum(observed.y), float(g.numerator.sum())
    verdict = judge(Findings(
        observed, gap, sqrt(gap_var), c_r, sqrt(max(c_r_var, 0.0)), float(np.abs(g.at(middle))[0]),
        total if structure.integrator else total / float(g.denominator.sum()),
        gain_std, float(spread.max()),
        # Whatever the correlation: what explains nine tenths of y shows v.
        inf if squares < 0.1 * still
        else 0.5 * effective(residual) * log(still / max(squares, TINY)),
        correlation, held_out.rms, held_out.trained,
        [(units.v_size * rival, behind) for rival, behind in s.rivals], best.reversals, step,
        cancelled_poles(best), structure.delay,
        # Where many fit alike, the gap does not depend on the delay.
        structure.delay == max(s.delays) and len(delays) < 3 and _delay_open(s.samples, best),
    ))
    # What no model explains moves both sides of the gap alike.
    more = 0.25 * (verdict.gap_std**2 - gap_var)
    # As parameters have it: z where G is a gain, for B acts a sample late.
    at_zero = structure.numerator_taps - structure.order
    free = len(residual) - structure.unknowns
    return replace(
        given, m=options.slope, gap=gap, c_r=c_r, c_l=c_r - gap,
        std={'m': options.slope * gain_std, 'gap': verdict.gap_std,
             'c_r': sqrt(max(c_r_var + more, 0.0)), 'c_l': sqrt(c_l_var + more)},
        numerator=tuple((g.numerator / options.slope).tolist()),
        denominator=(*best.denominator.tolist(), *[0.0] * at_zero),
        delay=structure.delay, delays=delays, integrator=structure.integrator,
        noise_std=units.y_size * sqrt(squares / max(free, 1)), quantum=step,
        correlation=correlation, ljung_box=ljung_box(best.residual),
        frequencies=frequencies, response_std=spread,
        uncertainty=_as_parameter(2.0 * float(spread.max())),
        reasons=verdict.reasons, remarks=verdict.remarks, verdict=verdict,
        details=Details(
            s.samples.first, units.v + units.v_size * best.problem.v, observed.y, observed.p,
            observed.simulated, g,
            tuple(one._replace(held_out=units.y_size * one.held_out) for one in s.compared), chosen,
            (units.v_size * s.profile[0], units.y_size * s.profile[1]), held_out),
    )


def _as_a_gain(
    found: Identification, s: _Search, given: Identification, options: Options, units: _Units,
) -> Identification:
    """With a G that is a gain and a delay, where a better one is not known but the gap is.

    A slow log of a position servo tells no more; what moves y otherwise counts as an error of G.
    """
    gains = [one for one in s.compared if one.structure.order == 0]
    assert found.verdict is not None
    if not gains or not found.verdict.backlash.known or found.verdict.model.known:
        return found
    chosen = min(gains, key=lambda one: one.whole.squares)
    best = fitted(s.samples, chosen.structure, chosen.trained.fit)
    # What depends on the model.
    apart = s.apart + 0.5 * abs(best.gap - found.gap / units.v_size)
    gain = _described(
        s._replace(chosen=chosen, best=best, apart=apart), given, options, units)
    assert gain.verdict is not None
    known = gain.verdict.backlash.known and gain.verdict.model.known
    if not known or apart * units.v_size >= CERTAIN * found.std['gap']:
        return found
    moved = sqrt(best.squares / float(np.var(best.problem.y[best.problem.known])) / len(best.left))
    return replace(gain, uncertainty=max(gain.uncertainty, _as_parameter(2.0 * moved)))


def _still(best: Model) -> float:
    """Squares left over by a u that stands still, through the same G."""
    problem, fit = best.problem, best.fit
    theta = fit.theta.copy()
    theta[2] = 2.0 * float(np.ptp(problem.v))
    y = problem.explained(replace(fit, p0=float(problem.v.max()), theta=theta))
    return max(float(np.sum((problem.y - y)[problem.known] ** 2)), TINY)


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative spread of G: one digit, upwards, and 1 % at least."""
    value = min(max(spread, 0.01), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
