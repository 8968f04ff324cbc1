"""Identify backlash, G(z), delay and noise from v and y, with standard deviations and a verdict.

    the best structure (structure_search.py)  ->  a fit of the whole record
    ->  standard deviations and verdict (verdict.py), all in units of the record

Search and fit are those of the loop, for plants with a vague prior (model.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation.fit import FIRST_STEPS
from backlash_ros.core.identification import model as models
from backlash_ros.core.identification import structure_search as search
from backlash_ros.core.identification.model import VAGUE, Model, Structure, Units, fitted
from backlash_ros.core.identification.structure_search import Options, Progress, StructureSearch
from backlash_ros.core.judgement.deviations import covariance_of, effective
from backlash_ros.core.judgement.not_play import Observed, limited, rate_limit
from backlash_ros.core.judgement.verdict import CERTAIN, WORTH_A_WORD, Findings, Verdict, judge
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records import readings


class Details(NamedTuple):
    """What figures show, in units of the record. first: index of the first y that was fitted; v:
    the v that acts on each y from there on."""

    first: int
    v: Array
    observed: Observed
    response: models.Response
    held_out: search.HeldOut


class FoundModel(NamedTuple):
    """y = z^-delay numerator / denominator u, for the given m. delays: all that explain y equally
    well. response_std: relative std of G at `frequencies` [rad/sample], which span the motion of y.
    uncertainty: for plant.uncertainty. quantum: step of y, or 0. outliers: readings left out."""

    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    delay: int = 0
    delays: tuple[int, ...] = ()
    integrator: bool = False
    frequencies: Array = np.empty(0)
    response_std: Array = np.empty(0)
    uncertainty: float = nan
    noise_std: float = nan
    quantum: float = 0.0
    outliers: int = 0


@dataclass(frozen=True)
class Identification:
    """The result. std: standard deviations of gap, c_r, c_l and, as m, of m times the gain of G.
    refused: why nothing was fitted, or why a controller rejects the result. verdict, details: None
    if nothing was fitted. actuator: between the command and v, if one was identified."""

    sample_period: float
    v: Array
    y: Array
    m: float = nan
    gap: float = nan
    c_r: float = nan
    std: dict[str, float] = field(default_factory=dict)
    model: FoundModel = field(default_factory=FoundModel)
    refused: str = ''
    verdict: Verdict | None = None
    details: Details | None = None
    actuator: Actuator | None = None

    @property
    def c_l(self) -> float:
        return self.c_r - self.gap

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why a controller cannot use the result, a sentence each; empty if it can."""
        return (self.refused,) if self.refused else self.verdict.reasons if self.verdict else ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """What else to know about the result, a sentence each."""
        return self.verdict.remarks if self.verdict else ()

    @property
    def hertz(self) -> Array:
        """Frequencies [Hz] at which the standard deviation of G is given."""
        return np.asarray(self.model.frequencies / (2.0 * np.pi * self.sample_period))

    def with_remarks(self, *remarks: str) -> Identification:
        """The result with these remarks instead of its own, if anything was fitted."""
        return replace(self, verdict=self.verdict and self.verdict._replace(remarks=remarks))

    @property
    def usable(self) -> bool:
        return not self.reasons


def identify(
    v: Array, y: Array, sample_period: float, options: Options | None = None,
    progress: Progress = lambda _: None,
) -> Identification:
    """Identify the plant from v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    progress: called with the name of each step as it begins. Raises ValueError for arrays of
    different lengths, a v that is not finite or a y that is infinite.
    """
    options = options or Options()
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    readings.check_record(v, y)
    part = readings.busiest(v, y)
    if nothing := _why_nothing(v, y[part], options):
        return Identification(sample_period, v, y, refused=nothing)
    slow = rate_limit(v[part], y[part])
    v = v if slow is None else limited(v, slow)
    given = Identification(sample_period, v, y)
    units = Units(float(v.mean()), float(np.ptp(v[part])), float(np.nanmedian(y)),
                  float(np.nanstd(y[part])))
    v, y = (v - units.v) / units.v_size, (y - units.y) / units.y_size
    s = search.searched(models.Samples(v[part], y[part], 0, 0, 0.0, units), options,
                        options.delays or search.EARLY, progress)
    s = s if options.delays else search.later(s, options, progress)
    progress('fitting the whole record')
    best, samples, rows = s.best, s.samples, effective(s.best.left)
    # Rivals differ in the delay alone and fit about as well.
    best = models.least_response(best, [
        one.whole for one in s.compared if one.whole.behind(best, rows) <= search.PLATEAU
        and one.structure != best.structure == replace(one.structure, delay=best.structure.delay)])
    longer = len(v) > len(samples.v)
    if longer:
        whole = y.copy()
        whole[part] = samples.y
        samples = replace(samples, v=v, y=whole, last=len(v))
        begin = best.begin(p0=float(v[0]) + 0.5 * best.gap)
        best = fitted(samples, best.structure, begin, steps=FIRST_STEPS)
    # A reading that was an outlier to the first model need not be one to the best.
    kept = search.cleaned(replace(samples, y=y), best)
    if kept.step != samples.step or not np.array_equal(kept.y, samples.y, equal_nan=True):
        samples = kept
        best = models.least_response(fitted(samples, best.structure, best.fit))
    elif longer:
        best = models.least_response(best)
    s = s._replace(samples=samples, best=best, held_out=s.held_out._replace(
        first=part.start + s.held_out.first))
    progress('judging')
    found = _as_a_gain(_described(s, given, options), s, options)
    remarks = [] if slow is None else [
        f'v jumps, and the drive follows at {slow / sample_period:.4g} per s at most: the fit is '
        'to v with this limit, which is control.rate_max in the file']
    drift = units.v_size * float(best.fit.knots.sum())
    if abs(drift) > WORTH_A_WORD * found.gap:
        remarks.append(f'c_r and c_l drift by {drift:.2g} over the record, or y drifts: given are '
                       'those at its end')
    return found.with_remarks(*remarks, *found.remarks)


def _why_nothing(v: Array, y: Array, options: Options) -> str:
    """Why nothing can be fitted, or ''. y: over the stretch that is searched."""
    known = np.isfinite(y[max(options.delays or search.EARLY) + 1:])
    # The first samples are fitted alone and have to predict the others.
    first = known[:len(known) - round(search.HELD_OUT * len(known))]
    needed = 8 * max(Structure(order, 0, False).unknowns
                     for order in (max(options.orders), search.GENERAL_POLES))
    if first.sum() < needed or not known[len(first):].any():
        return (
            f'{int(np.isfinite(y).sum())} samples of y are too few, or lie too unevenly, for an '
            f'order of up to {max(options.orders)}, about '
            f'{round(needed / (1.0 - search.HELD_OUT))} are needed: record for longer'
            + ', or limit --order' * (max(options.orders) > search.GENERAL_POLES))
    if np.ptp(v) == 0.0:
        return 'v stood still: move it to and fro, past the gap'
    if np.nanmax(y) == np.nanmin(y):
        return 'y stood still: let v swing wider than the gap, and check that y is measured'
    return ''


def _crossings(best: Model, covariance: Array, units: Units) -> tuple[float, list[float]]:
    """c_r and the variances of gap, c_r and c_l, in units of the record."""
    taps = best.structure.numerator_taps
    b, a = float(best.numerator.sum()), 1.0 + float(best.a.sum())
    # Unless G integrates, centring y has changed the offset.
    shift = 0.0 if best.structure.integrator or not b else units.y / units.y_size * a / b
    of_gap, of_c_r = np.zeros((2, len(covariance)))
    of_gap[2] = of_c_r[1] = 1.0
    of_c_r[3:3 + taps], of_c_r[3 + taps:] = VAGUE * shift / (b or inf), -VAGUE * shift / (a or inf)
    by = units.v_size * np.array([of_gap, of_c_r, of_c_r - of_gap])
    return units.v + units.v_size * (float(best.fit.theta[1]) - shift), \
        np.maximum(np.diag(by @ covariance @ by.T), 0.0).tolist()


def _described(s: StructureSearch, given: Identification, options: Options) -> Identification:
    """The result for the best fit: estimates, standard deviations, model and verdict."""
    best, structure, units = s.best, s.best.structure, s.samples.units
    covariance = covariance_of(best.problem, best.fit)
    c_r, (gap_var, c_r_var, c_l_var) = _crossings(best, covariance, units)
    unit = units.y_size / units.v_size
    g, numerator = models.response_of(best, covariance, unit), unit * best.numerator
    low, high = readings.frequencies_of(best.run.y)
    low = max(low, np.pi / len(best.run.y))
    frequencies = np.geomspace(low, max(high, 1.01 * low), 60, dtype=np.float64)
    spread, gain_std = g.std(frequencies), float(g.std(np.zeros(1))[0])
    middle, still = np.sqrt(frequencies[:1] * frequencies[-1:]), _still(best)
    delays = tuple(sorted({*search.equal_delays(s.compared, s.chosen), structure.delay}))
    observed, total = search.observed_of(s.samples, best), float(numerator.sum())
    static = total if structure.integrator else total / (1.0 + float(best.a.sum()))
    # If no structure explains y, likelihoods say little: all that predict about as well count
    # alike, and the median of their distances withstands a single odd one.
    alike = search.predictors(s.compared) if observed.unexplained else []
    apart = max(s.apart, readings.TO_STD * float(np.median(
        [abs(one.whole.gap - best.gap) for one in alike] or [0.0])))
    verdict = judge(Findings(
        observed, sqrt(gap_var), units.v_size * apart, sqrt(c_r_var),
        float(np.copysign(np.abs(g.at(middle))[0], static)), gain_std, float(spread.max()),
        # Whatever the correlation, a fit that explains nine tenths of y shows that v acts.
        inf if best.squares < 0.1 * still.squares
        else 0.5 * still.behind(best, effective(best.left)),
        [(units.v_size * rival, behind) for rival, behind in s.rivals], *_open_delay(s)))
    # Each crossing takes half of what the verdict adds to the deviation of the gap.
    more = 0.25 * (verdict.gap_std**2 - gap_var)
    # As in the parameters: a gain gets a pole at 0, since B acts one sample late.
    at_zero = structure.numerator_taps - structure.order
    return replace(
        given, m=options.slope, gap=units.v_size * best.gap, c_r=c_r, verdict=verdict,
        std={'m': options.slope * gain_std, 'gap': verdict.gap_std,
             'c_r': sqrt(max(c_r_var + more, 0.0)), 'c_l': sqrt(c_l_var + more)},
        model=FoundModel(
            tuple((numerator / options.slope).tolist()),
            (*best.denominator.tolist(), *[0.0] * at_zero), structure.delay, delays,
            structure.integrator, frequencies, spread, _as_parameter(2.0 * float(spread.max())),
            units.y_size * sqrt(best.squares / max(len(best.left) - structure.unknowns, 1)),
            readings.quantum(observed.y),
            int((np.isfinite(given.y) & np.isnan(s.samples.y)).sum())),
        details=Details(s.samples.first, units.v + units.v_size * best.problem.v, observed, g,
                        s.held_out))


def _open_delay(s: StructureSearch) -> tuple[int, float]:
    """The delay and the change of the gap [v] with one sample more, if the delay is the longest
    that was compared and one sample more fits as well; else zeros."""
    samples, taken = replace(s.samples, first=s.samples.first + 1), s.best.structure
    if not 0 < taken.delay == max(s.delays):
        return 0, 0.0
    this, other = (fitted(samples, structure, s.best.begin())
                   for structure in (taken, replace(taken, delay=taken.delay + 1)))
    if other.behind(this, effective(this.left)) >= search.PLATEAU:
        return 0, 0.0
    return taken.delay, samples.units.v_size * abs(other.gap - this.gap)


def _still(best: Model) -> Model:
    """The same G, driven by a u that stands still."""
    problem, theta = best.problem, best.fit.theta.copy()
    theta[2] = 2.0 * float(np.ptp(problem.v))
    still = replace(best.fit, p0=float(problem.v.max()), theta=theta)
    return replace(best, fit=problem.begun(still, True))


def _as_a_gain(found: Identification, s: StructureSearch, options: Options) -> Identification:
    """Take a gain and a delay for G if the gap is known but no better G is, as in a slow log of a
    position servo. Whatever else moves y then counts as an error of G."""
    gains = [one for one in s.compared if one.structure.order == 0]
    if not gains or not _known(found, False):
        return found
    chosen, v_size = min(gains, key=lambda one: one.whole.squares), s.samples.units.v_size
    best = fitted(s.samples, chosen.structure, chosen.trained.fit)
    # A gap that depends on the model is less certain.
    apart = s.apart + 0.5 * abs(best.gap - found.gap / v_size)
    gain = _described(s._replace(chosen=chosen, best=best, apart=apart), found, options)
    if not _known(gain, True) or apart * v_size >= CERTAIN * found.std['gap']:
        return found
    moved = sqrt(best.squares / float(np.var(best.problem.y[best.problem.known])) / len(best.left))
    uncertainty = max(gain.model.uncertainty, _as_parameter(2.0 * moved))
    return replace(gain, model=gain.model._replace(uncertainty=uncertainty))


def _known(found: Identification, model: bool) -> bool:
    """Whether the backlash is known and G is known, or not known, as `model` says."""
    return found.verdict is not None and found.verdict.backlash.known \
        and found.verdict.model.known == model


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative spread of G: rounded up to one digit, from 0.01 to 1."""
    value = min(max(spread, 0.01), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
