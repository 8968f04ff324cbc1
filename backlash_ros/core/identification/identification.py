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
from backlash_ros.core.identification.least_response import least_response
from backlash_ros.core.identification.not_play import Observed
from backlash_ros.core.identification.order_selection import (
    PLATEAU,
    Compared,
    cancelled_poles,
    compare,
    effective_rows,
    equal_delays,
    gives_way,
    held_out_rms,
    lag_one,
    predicted,
    selected,
)
from backlash_ros.core.identification.output_error import (
    Fit,
    Point,
    Samples,
    Structure,
    fit,
    linear_columns,
)
from backlash_ros.core.identification.separable_search import Profile, profile, search
from backlash_ros.core.identification.uncertainty import Covariance
from backlash_ros.core.identification.verdict import APART, Findings, Verdict, judge
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.roughness import noise_of
from backlash_ros.core.records.samples import busiest, check_record, frequencies_of, outliers

Array = NDArray[np.float64]
T = TypeVar('T')

GENERAL = Structure(3, 0, False)  # G with which the gap is searched first, and a tap per delay
FEWEST = 8  # samples per unknown below which nothing is fitted
SAME = 0.005  # relative distance of two gaps that are one
NEAR = np.linspace(0.8, 1.2, 17)  # gaps around the best one, relative
LEAST_UNCERTAINTY = 0.01  # of G: what a record does not show of a plant that is never quite linear
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class Options:
    """What is compared. integrators: of G, without and with one. slope: m, where it is known, else
    1: m and the gain of G cannot be told apart. held_out: share of the record, its last."""

    orders: Sequence[int] = (0, 1, 2, 3, 4)
    delays: Sequence[int] = (0, 1, 2, 3)
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
    first = max(options.delays) + 1
    searched = Samples(v[part], y[part], first)
    whole = GENERAL._replace(taps=GENERAL.order + max(options.delays))
    found = yield from _named('searching the gap', search(searched, whole))
    wild = _outliers(searched, found[0])
    if wild.any():
        searched = searched.without(wild)
        found = yield from _named('searching the gap again', search(searched, whole))
    candidates = _distinct(found)[:2]
    compared = yield from _named('comparing orders and delays', compare(
        searched, [one.point for one in candidates], options.orders, options.delays,
        options.integrators, options.held_out,
    ))
    while True:
        chosen = selected(compared)
        best, rivals, curve = yield from _named('refining', _refined(searched, chosen))
        if chosen.exact or not gives_way(best, compared):
            break
        # Only the best fit of all shows that a pole is none.
        compared = [one._replace(fit=best) if one is chosen else one for one in compared]
    alike = equal_delays(compared, chosen)
    rows = effective_rows(searched, best)
    # With as many poles, some of them may fit worse.
    others = [
        one for one in _with_delays(searched, best, alike)
        if rows * np.log(one.squares / max(best.squares, TINY)) <= PLATEAU
    ]
    best = yield from _named('choosing the delay', least_response(
        searched, best, others, best.squares / rows,
    ))
    samples, left_out = searched, int(wild.sum())
    if len(v) > len(searched.v):
        samples = Samples(v, y, first)
        best = _on_all(samples, best)
        wild = _outliers(samples, best)
        left_out = int(wild.sum())
        if left_out:
            samples = samples.without(wild)
            best = fit(samples, best.structure, best.point)
    yield 'judging'
    return _described(
        samples, searched, best, compared, chosen, rivals, curve, left_out,
        Identification(sample_period, v, y), options, part.start,
    )


def _nothing(v: Array, y: Array, sample_period: float, options: Options) -> Identification | None:
    """Where there is nothing to fit: why."""
    first = max(options.delays) + 1
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
    structure, swing = chosen.structure, samples.play.swing
    best = chosen.fit
    whole: Array = np.append(0.0, np.geomspace(1e-3, 0.99, 40) * swing)
    curve = yield from profile(samples, structure, whole, best)
    around = np.array([gap for gap in best.point.gap * NEAR if 0.0 < gap < swing])
    near = yield from profile(samples, structure, around, best)
    minima: list[Fit] = []
    for minimum in [*near.minima()[:3], *curve.minima()[:3]]:
        minima.append(fit(samples, structure, minimum.point))
        yield
    best = min([best, *minima], key=lambda one: one.squares)
    rows = effective_rows(samples, best)
    rivals = sorted(
        (behind, one.point.gap) for one in minima
        if abs(one.point.gap - best.point.gap) > APART * best.point.gap
        for behind in [0.5 * rows * float(np.log(one.squares / max(best.squares, TINY)))]
    )
    gaps = np.concatenate([curve.gaps, near.gaps, [best.point.gap]])
    order = np.argsort(gaps, kind='stable')
    fits = [*curve.fits, *near.fits, best]
    merged = Profile(
        gaps[order], np.array([fits[k].squares for k in order]), [fits[k] for k in order]
    )
    return best, [(gap, behind) for behind, gap in rivals], merged


def _on_all(samples: Samples, best: Fit) -> Fit:
    """The same structure on a longer record, at whose begin p may be anywhere in the gap."""
    v0, gap = float(samples.v[0]), best.point.gap
    fits = [
        fit(samples, best.structure, Point(best.point.a, gap, v0 + share * gap))
        for share in (0.0, 0.5, 1.0)
    ]
    return min(fits, key=lambda one: one.squares)


def _with_delays(samples: Samples, best: Fit, delays: Sequence[int]) -> list[Fit]:
    """The same structure with the other delays that fit alike."""
    return [
        fit(samples, best.structure._replace(delay=delay), best.point)
        for delay in delays if delay != best.structure.delay
    ]


def _described(
    samples: Samples, searched: Samples, best: Fit, compared: Sequence[Compared],
    chosen: Compared, rivals: list[tuple[float, float]], curve: Profile, left_out: int,
    given: Identification, options: Options, searched_from: int,
) -> Identification:
    """Everything there is to say of the best fit."""
    covariance = uncertainty.covariance_of(samples, best)
    crossings = uncertainty.crossings_covariance(best, covariance)
    gap_var, c_r_var = float(crossings[0, 0]), float(crossings[1, 1])
    c_l_var = max(gap_var + c_r_var - 2.0 * float(crossings[0, 1]), 0.0)
    band = frequencies_of(best.simulated)
    low = max(band[0], np.pi / samples.count)
    frequencies = np.geomspace(low, max(band[1], 1.01 * low), 60, dtype=np.float64)
    spread = uncertainty.response_std(best, covariance, frequencies)
    gain_std = float(uncertainty.response_std(best, covariance, np.zeros(1))[0])
    residual = samples.y - best.simulated
    rows = effective_rows(samples, best)
    still = _still(samples, best)
    correlation = max(lag_one(samples, best) - 3.0 / np.sqrt(len(samples.known)), 0.0)
    held_out = _held_out(searched, chosen, options.held_out)
    numerator = best.numerator / options.slope
    step = quantum(samples.y)
    total = float(best.numerator.sum())
    verdict = judge(Findings(
        _observed(samples, best, step), best.point.gap, float(np.sqrt(gap_var)), best.c_r,
        float(np.sqrt(c_r_var)),
        float(np.abs(uncertainty.response(best, np.sqrt(frequencies[:1] * frequencies[-1:])))[0]),
        total if best.structure.integrator else total / float(best.denominator.sum()),
        gain_std, float(spread.max()),
        # Whatever the correlation: what explains nine tenths of y shows v.
        inf if best.squares < 0.01 * still
        else 0.5 * rows * float(np.log(still / max(best.squares, TINY))),
        correlation, held_out.rms, held_out.trained, rivals, best.play.reversals, step,
        [_text(pole) for pole in cancelled_poles(best)], best.structure.delay,
        max(options.delays),
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
        delays=tuple(sorted({*equal_delays(compared, chosen), best.structure.delay})),
        integrator=best.structure.integrator, noise_std=float(np.sqrt(best.squares / freedom)),
        quantum=step, correlation=correlation,
        ljung_box=uncertainty.ljung_box(residual), frequencies=frequencies, response_std=spread,
        uncertainty=_as_parameter(float(spread.max())), outliers=left_out,
        reasons=verdict.reasons, remarks=verdict.remarks, verdict=verdict,
        details=Details(
            samples, searched, searched_from, best, covariance, tuple(compared), chosen, curve,
            held_out,
        ),
    )


def _still(samples: Samples, best: Fit) -> float:
    """Squares left over by a u that stands still, through the same G."""
    structure = best.structure
    columns = linear_columns(samples, structure, best.point.a, best.play.p)
    columns = columns[samples.known, structure.numerator_taps:]
    scale = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    basis = np.linalg.qr(columns / np.where(scale > 0.0, scale, 1.0))[0]
    left = samples.target - basis @ (basis.T @ samples.target)
    return max(float(left @ left), TINY)


def _observed(samples: Samples, best: Fit, step: float) -> Observed:
    """The signals of a fit, each where it acts on y."""
    y = samples.y
    noise = noise_of(samples.known.astype(float), samples.target)
    return Observed(
        samples.v[samples.first:samples.last], y,
        samples.delayed(best.play.p, best.structure.delay), best.simulated,
        max(noise, step / np.sqrt(12.0)), best.point.gap,
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
    return HeldOut(cut, predicted(trained, later), held_out_rms(trained, later), trained.rms)


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative deviation of G: of two deviations, one digit, upwards."""
    value = min(max(2.0 * spread, LEAST_UNCERTAINTY), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
