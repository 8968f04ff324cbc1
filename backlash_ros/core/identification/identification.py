"""From v and y to backlash, G(z), delay and noise, with deviations and all that keeps them apart.

    the best structure (structure_search.py)  ->  a fit of the whole record
    ->  deviations (deviations.py), verdict (verdict.py), all in units of the record

Search and fit are those of the loop, for plants without a prior (structure.py).
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import FIRST_STEPS
from backlash_ros.core.identification.deviations import (
    covariance_of,
    effective,
    lag_one,
    least_response,
    response_of,
)
from backlash_ros.core.identification.rate_limit import limited, rate_limit
from backlash_ros.core.identification.result import (
    Details,
    FoundModel,
    HeldOut,
    Identification,
    Noise,
    Options,
)
from backlash_ros.core.identification.structure import (
    TINY,
    VAGUE,
    Model,
    Samples,
    Structure,
    fitted,
    moved_to,
)
from backlash_ros.core.identification.structure_search import (
    EARLY,
    GENERAL_POLES,
    PLATEAU,
    Progress,
    StructureSearch,
    Units,
    equal_delays,
    later,
    observed_of,
    searched,
    without_outliers,
)
from backlash_ros.core.identification.verdict import CERTAIN, Findings, judge
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.samples import busiest, check_record, frequencies_of

Array = NDArray[np.float64]


def identify(
    v: Array, y: Array, sample_period: float, options: Options | None = None,
    progress: Progress = lambda _: None,
) -> Identification:
    """Identify v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    progress: is told what is being done. Raises ValueError for arrays that do not fit together or
    hold what is no number.
    """
    options = options or Options()
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    part = busiest(v, y)
    nothing = _why_nothing(v, y[part], options)
    if nothing:
        return Identification(sample_period, v, y, refused=nothing)
    slow = rate_limit(v[part], y[part])
    if slow is not None:
        v = limited(v, slow)
    given = Identification(sample_period, v, y)
    units = Units(float(v.mean()), float(np.ptp(v[part])), float(np.nanmedian(y)),
                  float(np.nanstd(y[part])))
    v, y = (v - units.v) / units.v_size, (y - units.y) / units.y_size
    s = searched(v[part], y[part], options, options.delays or EARLY, progress)
    if not options.delays:
        s = later(s, options, progress)
    progress('choosing the delay')
    best, rows = s.best, effective(s.best.left)
    structures = [replace(best.structure, delay=delay)
                  for delay in equal_delays(s.compared, s.chosen) if delay != best.structure.delay]
    others = [fitted(s.samples, one, moved_to(one, best)) for one in structures]
    # With as many poles, some of them may fit worse.
    best = least_response(best, [one for one in others if rows * log(
        max(one.squares, TINY) / max(best.squares, TINY)) <= PLATEAU])
    samples = s.samples
    if len(v) > len(samples.v):
        progress('fitting the whole record')
        whole = y.copy()
        whole[part] = samples.y
        samples = replace(samples, v=v, y=whole, last=len(v))
        begin = moved_to(best.structure, best, p0=float(v[0]) + 0.5 * best.gap)
        best = fitted(samples, best.structure, begin, FIRST_STEPS)
        kept = without_outliers(samples, best)
        if kept is not samples:
            samples = kept
            best = fitted(samples, best.structure, best.fit)
        best = least_response(best)
    progress('judging')
    s = s._replace(samples=samples, best=best, held_out=s.held_out._replace(
        first=part.start + s.held_out.first))
    found = _as_a_gain(_described(s, given, options, units), s, given, options, units)
    return found if slow is None else found.with_remarks([
        f'v jumps, and the drive follows by at most {slow / sample_period:.4g} per s: the fit is '
        'to v limited so, as is control.rate_max in the file', *found.remarks])


def _why_nothing(v: Array, y: Array, options: Options) -> str:
    """Why there is nothing to fit; empty where there is. y: of the part that is searched."""
    known = np.isfinite(y[max(options.delays or EARLY) + 1:])
    # The first samples of them are fitted alone, to predict the others.
    fitted = known[:len(known) - round(options.held_out * len(known))]
    needed = 8 * max(Structure(max(options.orders), 0, False).unknowns,
                          Structure(GENERAL_POLES, 0, False).unknowns)
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


def _delay_open(samples: Samples, best: Model) -> bool:
    """Whether one more sample of delay fits as well."""
    samples = replace(samples, first=samples.first + 1)
    longer = replace(best.structure, delay=best.structure.delay + 1)
    this, other = (fitted(samples, structure, moved_to(structure, best))
                   for structure in (best.structure, longer))
    ratio = log(max(other.squares, TINY) / max(this.squares, TINY))
    return bool(best.structure.delay) and effective(this.left) * ratio < PLATEAU


def _crossings(best: Model, covariance: Array, units: Units) -> tuple[float, Array]:
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
    s: StructureSearch, given: Identification, options: Options, units: Units,
) -> Identification:
    """Everything there is to say of the best fit."""
    best, chosen, structure = s.best, s.chosen, s.best.structure
    covariance = covariance_of(best.problem, best.fit)
    c_r, crossings = _crossings(best, covariance, units)
    gap, apart = units.v_size * best.gap, units.v_size * s.apart
    gap_var, c_r_var = np.diag(crossings).tolist()
    c_l_var = max(gap_var + c_r_var - 2.0 * float(crossings[0, 1]), 0.0)
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
    observed = observed_of(s.samples, best, units)
    step, total = quantum(observed.y), float(g.numerator.sum())
    static = total if structure.integrator else total / float(g.denominator.sum())
    verdict = judge(Findings(
        observed, sqrt(gap_var), apart, sqrt(max(c_r_var, 0.0)),
        float(np.copysign(np.abs(g.at(middle))[0], static)), gain_std, float(spread.max()),
        # Whatever the correlation: what explains nine tenths of y shows v.
        inf if squares < 0.1 * still
        else 0.5 * effective(residual) * log(still / max(squares, TINY)),
        held_out.rms / max(held_out.trained, 1e-300),
        [(units.v_size * rival, behind) for rival, behind in s.rivals],
        # Where many fit alike, the gap does not depend on the delay.
        structure.delay * (structure.delay == max(s.delays) and len(delays) < 3
                           and _delay_open(s.samples, best)),
    ))
    # What no model explains moves both sides of the gap alike.
    more = 0.25 * (verdict.gap_std**2 - gap_var)
    # As parameters have it: z where G is a gain, for B acts a sample late.
    at_zero = structure.numerator_taps - structure.order
    free = len(residual) - structure.unknowns
    details = Details(
        s.samples.first, units.v + units.v_size * best.problem.v, observed.y, observed.p,
        observed.simulated, g, held_out)
    return replace(
        given, m=options.slope, gap=gap, c_r=c_r,
        std={'m': options.slope * gain_std, 'gap': verdict.gap_std,
             'c_r': sqrt(max(c_r_var + more, 0.0)), 'c_l': sqrt(c_l_var + more)},
        model=FoundModel(
            tuple((g.numerator / options.slope).tolist()),
            (*best.denominator.tolist(), *[0.0] * at_zero), structure.delay, delays,
            structure.integrator, frequencies, spread, _as_parameter(2.0 * float(spread.max()))),
        noise=Noise(
            units.y_size * sqrt(squares / max(free, 1)), step, lag_one(residual, certain=True),
            int((np.isfinite(given.y) & np.isnan(s.samples.y)).sum())),
        fit=(details, verdict),
    )


def _as_a_gain(
    found: Identification, s: StructureSearch, given: Identification, options: Options,
    units: Units,
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
    uncertainty = max(gain.model.uncertainty, _as_parameter(2.0 * moved))
    return replace(gain, model=gain.model._replace(uncertainty=uncertainty))


def _still(best: Model) -> float:
    """Squares left over by a u that stands still, through the same G."""
    problem, fit = best.problem, best.fit
    theta = fit.theta.copy()
    theta[2] = 2.0 * float(np.ptp(problem.v))
    still = problem.begun(replace(fit, p0=float(problem.v.max()), theta=theta), True)
    return max(float(np.sum(problem.at(still).error ** 2)), TINY)


def _as_parameter(spread: float) -> float:
    """plant.uncertainty for a relative spread of G: one digit, upwards, and 1 % at least."""
    value = min(max(spread, 0.01), 1.0)
    digit = 10.0 ** np.floor(np.log10(value))
    return float(min(round(np.ceil(value / digit - 1e-9) * digit, 6), 1.0))
