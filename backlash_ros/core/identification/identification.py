"""From v and y to backlash, G(z), delay and noise, with deviations and all that keeps them apart.

    search the gap with a general G  ->  compare orders, delays, integrator on held-out samples
    ->  search the gap again with the one that is taken  ->  deviations, judgement
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification import uncertainty
from backlash_ros.core.identification.gap_search import (
    Profile,
    profile,
    search,
    steiglitz_mcbride,
)
from backlash_ros.core.identification.least_response import least_response
from backlash_ros.core.identification.not_play import Observed
from backlash_ros.core.identification.order_selection import (
    PLATEAU,
    TINY,
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
    Fit,
    Samples,
    Structure,
    best_start,
    fit,
    linear_rows,
    squares_of,
    triangle,
)
from backlash_ros.core.identification.uncertainty import Covariance
from backlash_ros.core.identification.verdict import (
    APART,
    SURE,
    Findings,
    Verdict,
    is_no_play,
    judge,
)
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.roughness import noise_of
from backlash_ros.core.records.samples import busiest, check_record, frequencies_of, outliers

Array = NDArray[np.float64]
T = TypeVar('T')

GENERAL = Structure(3, 0, False)  # G with which the gap is searched first, and a tap per delay
FEWEST = 8  # samples per unknown below which nothing is fitted
EARLY, LATEST = (0, 1, 2, 3), 40  # delays that are compared first, and the longest
WINDOW = 4  # delays from one look at later ones to the next
SHORTEST = 20  # samples of a record for each of the delay, at least
LATER = 5.0  # log-likelihood by which a later delay must fit better
ALIKE = 1.3  # ratio of the squares left over of delays that may be the right one
ROWS = 1200  # in which gaps are compared: of more samples, neighbours are averaged
SAME = 0.005  # relative distance of two gaps that are one
NEAR = np.linspace(0.8, 1.2, 13)  # gaps around the best one, relative
WHOLE = 24  # gaps over the swing of v
LEAST_UNCERTAINTY = 0.01  # of G: what a record does not show of a plant that is never quite linear


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


class _Search(NamedTuple):
    """The best of the structures that were compared. rivals: other minima (gap, how far behind).

    apart: deviation of the gap beside the fit's, by a later delay that fits alike.
    """

    samples: Samples
    compared: list[Compared]
    chosen: Compared
    best: Fit
    rivals: list[tuple[float, float]]
    curve: Profile
    delays: Sequence[int]
    apart: float = 0.0


def identifying(
    v: Array, y: Array, sample_period: float, options: Options,
) -> Generator[str, None, Identification]:
    """The same in pieces of some ten milliseconds; yields what is being done."""
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    nothing = _nothing(v, y, sample_period, options)
    if nothing is not None:
        return nothing
    part = busiest(v, y)
    s = yield from _searched(v[part], y[part], options, options.delays or EARLY)
    late = not options.delays and s.chosen.structure.delay == EARLY[-1]
    # What no G with a backlash explains, any delay explains a little better.
    if late and _delay_open(s.samples, s.best) and not is_no_play(_observed(s.samples, s.best)):
        s = yield from _later(s, options)
    rows = effective_rows(s.samples, s.best)
    # With as many poles, some of them may fit worse.
    others = [
        one for one in _with_delays(s.samples, s.best, equal_delays(s.compared, s.chosen))
        if rows * np.log(one.squares / max(s.best.squares, TINY)) <= PLATEAU
    ]
    best, penalty = yield from _named('choosing the delay', least_response(
        s.samples, s.best, others, s.best.squares / rows,
    ))
    yield 'fitting the whole record'
    kept = y.copy()
    kept[part] = s.samples.whole_y
    samples = Samples(v, kept, max(s.delays) + 1)
    if len(v) > len(s.samples.v):
        best = _on_all(samples, best, penalty)
        wild = _outliers(samples, best)
        samples = samples.without(wild) if wild.any() else samples
    best = fit(samples, best.structure, best.point, penalty=penalty)
    yield 'judging'
    left_out = int((np.isfinite(y) & np.isnan(samples.whole_y)).sum())
    given = replace(Identification(sample_period, v, y), outliers=left_out)
    found = _described(samples, s, best, given, options, part.start, s.apart)
    return _as_a_gain(found, samples, s, given, options, part.start)


def _as_a_gain(
    found: Identification, samples: Samples, s: _Search, given: Identification, options: Options,
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
    best = fit(samples, chosen.structure, chosen.trained.point)
    apart = s.apart + 0.5 * abs(best.point.gap - found.gap)  # what depends on the model
    gain = _described(
        samples, s._replace(chosen=chosen), best, given, options, searched_from, apart)
    assert gain.verdict is not None
    if not (gain.verdict.backlash.known and gain.verdict.model.known
            and apart < SURE * found.std['gap']):
        return found
    moved = float(np.sqrt(best.squares / np.nanvar(samples.y) / len(samples.known)))
    return replace(gain, uncertainty=max(gain.uncertainty, _as_parameter(moved)))


def _searched(
    v: Array, y: Array, options: Options, delays: Sequence[int],
) -> Generator[str, None, _Search]:
    """The best structure with one of these delays."""
    samples = Samples(v, y, max(delays) + 1)
    whole = _general(min(delays), max(delays))
    found = yield from _named('searching the gap', search(samples.coarse(ROWS), whole))
    wild = _outliers(samples, fit(samples, whole, found[0].point))
    if wild.any():
        samples = samples.without(wild)
        found = yield from _named('searching the gap again', search(
            samples.coarse(ROWS), whole))
    compared = yield from _named('comparing orders and delays', compare(
        samples, [one.point for one in _distinct(found)[:2]], options.orders, delays,
        options.integrators, options.held_out,
    ))
    finalists = [one for one in compared if np.isfinite(one.criterion)]
    while True:
        chosen = selected(finalists)
        best, rivals, curve = yield from _named('refining', _refined(samples, chosen))
        if chosen.exact or not gives_way(best, finalists):
            return _Search(samples, compared, chosen, best, rivals, curve, delays)
        # Only the best fit of all shows that a pole is none.
        finalists = [one._replace(fit=best) if one is chosen else one for one in finalists]


def _later(early: _Search, options: Options) -> Generator[str, None, _Search]:
    """The search among later delays, where one of them explains y better."""
    v, y = early.samples.v, early.samples.whole_y
    latest = min(LATEST, len(v) // SHORTEST)
    samples = Samples(v, y, latest + 1, most=ROWS)
    gaps = np.append(early.best.point.gap * np.array([1.0, 0.75, 0.5]),
                     samples.swing * np.geomspace(0.01, 0.5, 5))
    left: dict[int, float] = {}
    for delay in range(0, latest, WINDOW):
        structure = _general(delay, delay + WINDOW)
        for gap in gaps.tolist():
            p = samples.played(gap, float(v[0]) + 0.5 * gap)
            a = steiglitz_mcbride(samples, structure, p)[0]
            left[delay] = min(squares_of(samples, structure, a, p), left.get(delay, inf))
        yield 'searching later delays'
    # Of a smooth motion many delays tell alike.
    delay = min(delay for delay, squares in left.items() if squares <= ALIKE * min(left.values()))
    delay = max(delay, WINDOW)  # taps of a shorter one reach as far
    window = range(delay - 1, min(delay + WINDOW + 2, latest) + 1)
    late = yield from _searched(v, y, options, window)
    ratio = max(early.best.rms, TINY) / max(late.best.rms, TINY)
    better = effective_rows(late.samples, late.best) * float(np.log(ratio))
    inner = late.best.structure.delay < max(window)
    if inner and better > LATER:
        return late
    apart = 0.5 * abs(late.best.point.gap - early.best.point.gap)
    return early._replace(apart=apart) if better > -LATER else early


def _general(first: int, last: int) -> Structure:
    """G with which the gap is searched: a few poles, and a tap for each delay."""
    return GENERAL._replace(delay=first, taps=GENERAL.order + last - first)


def _nothing(v: Array, y: Array, sample_period: float, options: Options) -> Identification | None:
    """Where there is nothing to fit: why."""
    first = max(options.delays or EARLY) + 1
    part = busiest(v, y)
    known = np.isfinite(y[part][first:])
    # The first samples of them are fitted alone, to predict the others.
    fitted = known[:len(known) - round(options.held_out * len(known))]
    needed = FEWEST * max(Structure(max(options.orders), 0, False).unknowns, GENERAL.unknowns)
    reason = ''
    if fitted.sum() < needed or not known[len(fitted):].any():
        reason = (
            f'{int(known.sum())} samples of y are too few, or lie too unevenly, for an order of up '
            f'to {max(options.orders)}, about {round(needed / (1.0 - options.held_out))} are '
            'needed: record for longer, or limit --order'
        )
    elif np.ptp(v) == 0.0:
        reason = 'v stood still: move it to and fro, past the gap'
    elif np.nanmax(y) == np.nanmin(y):
        reason = 'y stood still: let v swing wider than the gap, and see that y is measured'
    return Identification(sample_period, v, y, reasons=(reason,)) if reason else None


def _named(stage: str, work: Generator[None, None, T]) -> Generator[str, None, T]:
    """The pieces of a generator under the name of what is done."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            result: T = done.value
            return result
        yield stage


def _outliers(samples: Samples, found: Fit) -> NDArray[np.bool_]:
    """Readings that are none; rounding makes none."""
    return outliers(samples.y - found.simulated, quantum(samples.y))


def _distinct(found: Sequence[Fit]) -> list[Fit]:
    """Those whose gaps differ from all better ones."""
    kept: list[Fit] = []
    for one in found:
        gap = one.point.gap
        if all(abs(gap - other.point.gap) > SAME * other.point.gap for other in kept):
            kept.append(one)
    return kept


def _refined(
    samples: Samples, chosen: Compared,
) -> Generator[None, None, tuple[Fit, list[tuple[float, float]], Profile]]:
    """The best fit of the chosen structure, other minima (gap, how far behind), the profile."""
    structure, swing = chosen.structure, samples.swing
    coarse = samples.coarse(ROWS)
    centre = fit(coarse, structure, chosen.fit.point)
    whole: Array = np.append(0.0, np.geomspace(1e-3, 0.99, WHOLE) * swing)
    curve = yield from profile(coarse, structure, whole, centre)
    around = np.array([gap for gap in centre.point.gap * NEAR if 0.0 < gap < swing])
    near = yield from profile(coarse, structure, around, centre)
    minima: list[Fit] = []
    for minimum in [*near.minima()[:3], *curve.minima()[:3]]:
        minima.append(fit(samples, structure, minimum.point))
        yield
    best = min([chosen.fit, *minima], key=lambda one: one.squares)
    rows = effective_rows(samples, best)
    rivals = sorted(
        (behind, one.point.gap) for one in minima
        if abs(one.point.gap - best.point.gap) > APART * best.point.gap
        for behind in [0.5 * rows * float(np.log(one.squares / max(best.squares, TINY)))]
    )
    gaps = np.concatenate([curve.gaps, near.gaps, [centre.point.gap]])
    order = np.argsort(gaps, kind='stable')
    fits = [*curve.fits, *near.fits, centre]
    merged = Profile(
        gaps[order], np.array([fits[k].squares for k in order]), [fits[k] for k in order]
    )
    return best, [(gap, behind) for behind, gap in rivals], merged


def _on_all(samples: Samples, best: Fit, penalty: Array | None) -> Fit:
    """The same structure on a longer record, at whose begin p may be anywhere in the gap."""
    v0, gap = float(samples.v[0]), best.point.gap
    starts = [v0 + share * gap for share in (0.0, 0.5, 1.0)]
    begin = best_start(samples, best.structure, [best.point.a], gap, starts)
    return fit(samples, best.structure, begin, penalty=penalty)


def _with_delays(samples: Samples, best: Fit, delays: Sequence[int]) -> list[Fit]:
    """The same structure with the other delays that fit alike."""
    return [
        fit(samples, best.structure._replace(delay=delay), best.point)
        for delay in delays if delay != best.structure.delay
    ]


def _described(
    samples: Samples, s: _Search, best: Fit, given: Identification, options: Options,
    searched_from: int, apart: float = 0.0,
) -> Identification:
    """Everything there is to say of the best fit. apart: deviation of the gap beside the fit's."""
    covariance = uncertainty.covariance_of(samples, best)
    crossings = uncertainty.crossings_covariance(best, covariance)
    gap_var, c_r_var = float(crossings[0, 0]), float(crossings[1, 1])
    c_l_var = max(gap_var + c_r_var - 2.0 * float(crossings[0, 1]), 0.0)
    gap_var += apart**2
    band = frequencies_of(best.simulated)
    low = max(band[0], np.pi / samples.count)
    frequencies = np.geomspace(low, max(band[1], 1.01 * low), 60, dtype=np.float64)
    spread = uncertainty.response_std(best, covariance, frequencies)
    gain_std = float(uncertainty.response_std(best, covariance, np.zeros(1))[0])
    residual = samples.y - best.simulated
    rows = effective_rows(samples, best)
    still = _still(samples, best)
    correlation = max(
        lag_one(residual[samples.known]) - 3.0 / np.sqrt(len(samples.known)), 0.0)
    held_out = _held_out(s.samples, s.chosen, options.held_out)
    numerator = best.numerator / options.slope
    step = quantum(samples.y)
    total = float(best.numerator.sum())
    verdict = judge(Findings(
        _observed(samples, best), best.point.gap, float(np.sqrt(gap_var)), best.c_r,
        float(np.sqrt(c_r_var)),
        float(np.abs(uncertainty.response(best, np.sqrt(frequencies[:1] * frequencies[-1:])))[0]),
        total if best.structure.integrator else total / float(best.denominator.sum()),
        gain_std, float(spread.max()),
        # Whatever the correlation: what explains nine tenths of y shows v.
        inf if best.squares < 0.01 * still
        else 0.5 * rows * float(np.log(still / max(best.squares, TINY))),
        correlation, held_out.rms, held_out.trained, s.rivals, best.reversals, step,
        [_text(pole) for pole in cancelled_poles(best)], best.structure.delay,
        best.structure.delay == max(s.delays) and _delay_open(samples, best),
    ))
    # What no model explains moves both sides of the gap alike.
    more = 0.25 * (verdict.gap_std**2 - gap_var)
    freedom = max(len(samples.known) - best.structure.unknowns, 1)
    return replace(
        given, m=options.slope, gap=best.point.gap, c_r=best.c_r, c_l=best.c_r - best.point.gap,
        std={
            'm': options.slope * gain_std, 'gap': verdict.gap_std,
            'c_r': float(np.sqrt(c_r_var + more)), 'c_l': float(np.sqrt(c_l_var + more)),
        },
        numerator=tuple(numerator.tolist()), denominator=_proper(best),
        delay=best.structure.delay,
        delays=tuple(sorted({*equal_delays(s.compared, s.chosen), best.structure.delay})),
        integrator=best.structure.integrator, noise_std=float(np.sqrt(best.squares / freedom)),
        quantum=step, correlation=correlation,
        ljung_box=uncertainty.ljung_box(residual), frequencies=frequencies, response_std=spread,
        uncertainty=_as_parameter(float(spread.max())),
        reasons=verdict.reasons, remarks=verdict.remarks, verdict=verdict,
        details=Details(
            samples, s.samples, searched_from, best, covariance, tuple(s.compared), s.chosen,
            s.curve, held_out,
        ),
    )


def _delay_open(samples: Samples, best: Fit) -> bool:
    """Whether one more sample of delay fits as well."""
    later = Samples(samples.v, samples.whole_y, samples.first + 1)
    longer = best.structure._replace(delay=best.structure.delay + 1)
    this, other = (fit(later, structure, best.point) for structure in (best.structure, longer))
    ratio = float(np.log(max(other.squares, TINY) / max(this.squares, TINY)))
    return bool(best.structure.delay) and effective_rows(later, this) * ratio < PLATEAU


def _still(samples: Samples, best: Fit) -> float:
    """Squares left over by a u that stands still, through the same G."""
    rows = linear_rows(samples, best.structure, best.point.a, best.p)
    without = samples.reduced(rows[best.structure.numerator_taps:])
    r, scale = triangle(np.vstack([without, samples.target]))
    return max(float(r[-1, -1] * scale[-1]) ** 2, TINY)


def _observed(samples: Samples, best: Fit) -> Observed:
    """The signals of a fit, each where it acts on y."""
    noise = noise_of(samples.known.astype(float), samples.y[samples.known])
    return Observed(
        samples.v[samples.first:samples.last], samples.y,
        samples.delayed(best.p, best.structure.delay), best.simulated,
        max(noise, quantum(samples.y) / np.sqrt(12.0)), best.point.gap,
    )


def _proper(found: Fit) -> tuple[float, ...]:
    """The denominator as parameters have it: z where G is a gain, for B acts a sample late."""
    at_zero = found.structure.numerator_taps - found.structure.order
    return (*found.denominator.tolist(), *[0.0] * at_zero)


def _text(root: complex) -> str:
    return f'{root.real:.4g}' if abs(root.imag) < 1e-9 else f'{root:.4g}'


def _held_out(samples: Samples, chosen: Compared, share: float) -> HeldOut:
    """What the structure, fitted to the first part alone, predicts of the last."""
    cut = samples.last - round(share * samples.count)
    later = samples.part(cut, samples.last)
    trained = chosen.trained
    return HeldOut(cut, predicted(trained, later), chosen.held_out, trained.rms)


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative deviation of G: of two deviations, one digit, upwards."""
    value = min(max(2.0 * spread, LEAST_UNCERTAINTY), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
