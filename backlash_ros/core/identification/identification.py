"""From v and y to backlash, G(z), delay and noise, with deviations and all that keeps them apart.

    search the gap with a general G  ->  compare orders, delays, integrator on held-out samples
    ->  search the gap again with the one that is taken  ->  deviations, judgement
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from math import exp, inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification import uncertainty
from backlash_ros.core.identification.gap_search import SEARCH_ROWS, Profile, search
from backlash_ros.core.identification.least_response import least_response
from backlash_ros.core.identification.not_play import Observed, what_it_is
from backlash_ros.core.identification.order_selection import (
    PLATEAU,
    RACE_STEPS,
    Compared,
    cancelled_poles,
    compare,
    effective_rows,
    equal_delays,
    gives_way,
    lag_one,
    predicted,
    selected,
)
from backlash_ros.core.identification.output_error import (
    TINY,
    Fit,
    Samples,
    Structure,
    best_start,
    fit,
    linear_rows,
    squares_left,
    steiglitz_mcbride,
    triangle,
)
from backlash_ros.core.identification.uncertainty import Covariance
from backlash_ros.core.identification.verdict import ANOTHER, CERTAIN, Findings, Verdict, judge
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.roughness import noise_of
from backlash_ros.core.records.samples import busiest, check_record, frequencies_of, outliers

Array = NDArray[np.float64]

POLES = 3  # of the general G with which the gap is searched first; it has a tap for each delay
EARLY, LONGEST_DELAY = (0, 1, 2, 3), 40  # delays that are compared first, and the longest
ALIKE = 5.0  # log-likelihood by which a delay that fits alike may be worse


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
    """Prediction of samples that were not fitted. first: index of the first of them; simulated
    (M,); rms of the error; trained: rms of the fit to the samples before."""

    first: int
    simulated: Array
    rms: float
    trained: float


class Details(NamedTuple):
    """What pictures show. samples: all that was fitted; searched: the part of it, from sample
    searched_from on, in which structures were compared. profile: of the gap."""

    samples: Samples
    searched: Samples
    searched_from: int
    fit: Fit
    covariance: Covariance
    compared: tuple[Compared, ...]
    chosen: Compared
    profile: Profile
    held_out: HeldOut


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


class _Search(NamedTuple):
    """The best of the structures that were compared. rivals: other minima (gap, how far behind).

    apart: deviation of the gap beside the fit's, by a model or a delay that fits alike.
    """

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Fit
    rivals: list[tuple[float, float]]
    curve: Profile
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
    s = yield from _searched(v[part], y[part], options, options.delays or EARLY)
    if not options.delays:
        s = yield from _later(s, options)
    yield 'choosing the delay'
    best, rows = s.best, effective_rows(s.best)
    others = [
        fit(s.samples, best.structure._replace(delay=delay), best.point)
        for delay in equal_delays(s.compared, s.chosen) if delay != best.structure.delay
    ]
    # With as many poles, some of them may fit worse.
    best = least_response(best, [
        one for one in others if rows * log(max(one.squares, TINY) / max(best.squares, TINY))
        <= PLATEAU
    ], best.squares / rows)
    if len(v) > len(s.samples.v):
        yield 'fitting the whole record'
        kept = y.copy()
        kept[part] = s.samples.whole_y
        samples = Samples(v, kept, s.samples.first, len(v), penalty=best.samples.penalty)
        begin = best_start(samples, best.structure, [best.point.a], best.point.gap, (0.0, 0.5, 1.0))
        best = fit(samples, best.structure, begin)
        wild = _without_outliers(samples, best)
        best = best if wild is samples else fit(wild, best.structure, best.point)
    yield 'judging'
    given = replace(given, outliers=int((np.isfinite(y) & np.isnan(best.samples.whole_y)).sum()))
    found = _described(s, best, given, options, part.start)
    return _as_a_gain(found, s, best, given, options, part.start)


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


def _general(first: int, last: int) -> Structure:
    """G with which the gap is searched: a few poles, and a tap for each delay."""
    return Structure(POLES, first, False, POLES + last - first)


def _searched(
    v: Array, y: Array, options: Options, delays: Sequence[int],
) -> Generator[str, None, _Search]:
    """The best structure with one of these delays."""
    far_off = 0.03  # relative distance of the last gap from the first, with which to begin anew
    samples, whole = Samples(v, y, max(delays) + 1, len(v)), _general(min(delays), max(delays))
    yield 'searching the gap'
    found, _ = search(samples, whole)
    kept = _without_outliers(samples, fit(samples, whole, found[0].point))
    if kept is not samples:
        samples = kept
        found, _ = search(samples, whole)
    candidates = [one.point for one in found[:2]]
    structures = [
        Structure(order, delay, integrator) for integrator in options.integrators
        for delay in delays for order in options.orders if order >= integrator
    ]
    for again in (True, False):
        yield 'comparing orders and delays'
        compared = compare(samples, candidates, structures, options.held_out)
        yield 'refining'
        while True:
            chosen = selected(compared)
            best, rivals, curve = _refined(samples, chosen)
            if not gives_way(best, compared):
                break
            # Only the best fit of all shows that a pole is none.
            compared = [one._replace(fit=best) if one is chosen else one for one in compared]
        off = abs(best.point.gap - candidates[0].gap)
        if not again or off <= far_off * best.point.gap:
            break
        candidates = [best.point, candidates[0]]  # the general G may have been a poor one
    return _Search(samples, compared, chosen, best, rivals, curve, delays)


def _without_outliers(samples: Samples, found: Fit) -> Samples:
    """The same without readings that are none; rounding makes none."""
    wild = outliers(found.residual, quantum(samples.y))
    if not wild.any():
        return samples
    y = samples.whole_y.copy()
    y[samples.first:samples.last][wild] = nan
    return replace(samples, whole_y=y)


def _refined(
    samples: Samples, chosen: Compared,
) -> tuple[Fit, list[tuple[float, float]], Profile]:
    """The best fit of the chosen structure, other minima (gap, how far behind), the profile."""
    found, curve = search(samples, chosen.structure, chosen.fit)
    near = [one for one in found if one.squares < 1.5 * found[0].squares]
    fits = [chosen.fit, *(fit(samples, chosen.structure, one.point) for one in near[:5])]
    best = min(fits, key=lambda one: one.squares)
    rows, gap = effective_rows(best), best.point.gap
    rivals = sorted(
        (0.5 * rows * log(max(one.squares, TINY) / max(best.squares, TINY)), one.point.gap)
        for one in fits if abs(one.point.gap - gap) > ANOTHER * gap
    )
    return best, [(gap, behind) for behind, gap in rivals], curve


def _later(early: _Search, options: Options) -> Generator[str, None, _Search]:
    """The search among later delays, where one of them explains y as well or better.

    The same structure is fitted with one sample of delay more and more, from the fit before.
    """
    most_alike = 8  # delays that fit alike, beyond which none of them is told
    worse_for = 3  # delays in a row that fit worse, behind which no later one is tried
    yield 'searching later delays'
    best, latest = early.best, min(LONGEST_DELAY, len(early.samples.v) // 20)
    samples = replace(early.samples, first=latest + 1, most=SEARCH_ROWS)
    scan = [fit(samples, best.structure, best.point)]
    alike, rows = list(scan), effective_rows(scan[0])
    while scan[-1].structure.delay < min(latest, alike[-1].structure.delay + worse_for):
        (a, gap, start), delay = scan[-1].point, scan[-1].structure.delay + 1
        structure = best.structure._replace(delay=delay)
        models = [a, *steiglitz_mcbride(samples, structure, scan[-1].p)[:1]]
        scan.append(fit(
            samples, structure, best_start(samples, structure, models, gap, (), start), RACE_STEPS))
        most = min(one.squares for one in scan) * exp(2.0 * ALIKE / rows)
        alike = [one for one in scan if one.squares <= most]
    first, last = (alike[k].structure.delay for k in (0, -1))
    if last <= EARLY[-1]:
        return early
    gaps = [one.point.gap for one in (best, *alike)]
    early = early._replace(apart=0.5 * (max(gaps) - min(gaps)))
    # What no G with a backlash explains, any delay explains a little better.
    other = what_it_is(_observed(best))
    if last - first > most_alike or (other is not None and not other.known):
        return early
    late = yield from _searched(early.samples.v, early.samples.whole_y, options, range(
        max(first - 1, 0), min(last + 2, latest) + 1))
    better = effective_rows(late.best) * log(max(best.rms, TINY) / max(late.best.rms, TINY))
    return late if late.best.structure.delay < max(late.delays) and better > -ALIKE else early


def _delay_open(best: Fit) -> bool:
    """Whether one more sample of delay fits as well."""
    samples = replace(best.samples, first=best.samples.first + 1)
    longer = best.structure._replace(delay=best.structure.delay + 1)
    this, other = (fit(samples, structure, best.point) for structure in (best.structure, longer))
    ratio = log(max(other.squares, TINY) / max(this.squares, TINY))
    return bool(best.structure.delay) and effective_rows(this) * ratio < PLATEAU


def _observed(best: Fit) -> Observed:
    """The signals of a fit, each where it acts on y."""
    samples = best.samples
    noise = noise_of(samples.known.astype(float), samples.y[samples.known])
    return Observed(
        samples.v[samples.first:samples.last], samples.y,
        samples.delayed(best.p, best.structure.delay), best.simulated,
        max(noise, quantum(samples.y) / sqrt(12.0)), best.point.gap,
    )


def _described(
    s: _Search, best: Fit, given: Identification, options: Options, searched_from: int,
) -> Identification:
    """Everything there is to say of the best fit."""
    samples, structure = best.samples, best.structure
    covariance = uncertainty.covariance_of(best)
    crossings = uncertainty.crossings_covariance(best, covariance)
    gap_var, c_r_var = np.diag(crossings).tolist()
    c_l_var = max(gap_var + c_r_var - 2.0 * float(crossings[0, 1]), 0.0)
    gap_var += s.apart**2
    band = frequencies_of(best.simulated)
    low = max(band[0], np.pi / samples.count)
    frequencies = np.geomspace(low, max(band[1], 1.01 * low), 60, dtype=np.float64)
    spread = uncertainty.response_std(best, covariance, frequencies)
    gain_std = float(uncertainty.response_std(best, covariance, np.zeros(1))[0])
    middle = np.sqrt(frequencies[:1] * frequencies[-1:])
    residual = best.residual[samples.known]
    squares, still = float(residual @ residual), _still(best)
    chosen = s.chosen
    cut = s.samples.last - round(options.held_out * s.samples.count)
    held_out = HeldOut(cut, predicted(chosen.trained, replace(s.samples, first=cut)),
                       chosen.held_out, chosen.trained.rms)
    delays = tuple(sorted({*equal_delays(s.compared, chosen), structure.delay}))
    correlation = max(lag_one(residual) - 3.0 / sqrt(len(residual)), 0.0)
    step, total = quantum(samples.y), float(best.numerator.sum())
    verdict = judge(Findings(
        _observed(best), best.point.gap, sqrt(gap_var), best.c_r, sqrt(max(c_r_var, 0.0)),
        float(np.abs(uncertainty.response(best, middle))[0]),
        total if structure.integrator else total / float(best.denominator.sum()),
        gain_std, float(spread.max()),
        # Whatever the correlation: what explains nine tenths of y shows v.
        inf if squares < 0.01 * still
        else 0.5 * effective_rows(best) * log(still / max(squares, TINY)),
        correlation, held_out.rms, held_out.trained, s.rivals, best.reversals, step,
        cancelled_poles(best), structure.delay,
        # Where many fit alike, the gap does not depend on the delay.
        structure.delay == max(s.delays) and len(delays) < 3 and _delay_open(best),
    ))
    # What no model explains moves both sides of the gap alike.
    more = 0.25 * (verdict.gap_std**2 - gap_var)
    # As parameters have it: z where G is a gain, for B acts a sample late.
    at_zero = structure.numerator_taps - structure.order
    return replace(
        given, m=options.slope, gap=best.point.gap, c_r=best.c_r, c_l=best.c_r - best.point.gap,
        std={'m': options.slope * gain_std, 'gap': verdict.gap_std,
             'c_r': sqrt(max(c_r_var + more, 0.0)), 'c_l': sqrt(c_l_var + more)},
        numerator=tuple((best.numerator / options.slope).tolist()),
        denominator=(*best.denominator.tolist(), *[0.0] * at_zero),
        delay=structure.delay,
        delays=delays,
        integrator=structure.integrator,
        noise_std=sqrt(squares / max(len(residual) - structure.unknowns, 1)),
        quantum=step, correlation=correlation, ljung_box=uncertainty.ljung_box(best.residual),
        frequencies=frequencies, response_std=spread,
        uncertainty=_as_parameter(2.0 * float(spread.max())),
        reasons=verdict.reasons, remarks=verdict.remarks, verdict=verdict,
        details=Details(samples, s.samples, searched_from, best, covariance, tuple(s.compared),
                        chosen, s.curve, held_out),
    )


def _as_a_gain(
    found: Identification, s: _Search, best: Fit, given: Identification, options: Options,
    searched_from: int,
) -> Identification:
    """With a G that is a gain and a delay, where a better one is not known but the gap is.

    A slow log of a position servo tells no more; what moves y otherwise counts as an error of G.
    """
    gains = [one for one in s.compared if one.structure.order == 0]
    assert found.verdict is not None
    if not gains or not found.verdict.backlash.known or found.verdict.model.known:
        return found
    chosen = min(gains, key=lambda one: one.fit.squares)
    best = fit(replace(best.samples, penalty=None), chosen.structure, chosen.trained.point)
    apart = s.apart + 0.5 * abs(best.point.gap - found.gap)  # what depends on the model
    gain = _described(
        s._replace(chosen=chosen, apart=apart), best, given, options, searched_from)
    assert gain.verdict is not None
    known = gain.verdict.backlash.known and gain.verdict.model.known
    if not known or apart >= CERTAIN * found.std['gap']:
        return found
    moved = sqrt(best.squares / float(np.nanvar(best.samples.y)) / len(best.samples.known))
    return replace(gain, uncertainty=max(gain.uncertainty, _as_parameter(2.0 * moved)))


def _still(best: Fit) -> float:
    """Squares left over by a u that stands still, through the same G."""
    samples, structure = replace(best.samples, penalty=None), best.structure
    rows = linear_rows(samples, structure, best.point.a, best.p)[structure.numerator_taps:]
    return max(squares_left(triangle(np.vstack([samples.reduced(rows), samples.target]))), TINY)


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative spread of G: one digit, upwards, and 1 % at least."""
    value = min(max(spread, 0.01), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
