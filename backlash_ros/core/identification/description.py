"""From the best fit to crossings, G, their deviations and the verdict, in units of the record."""

from __future__ import annotations

from dataclasses import replace
from math import inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.deviations import covariance_of, ljung_box
from backlash_ros.core.identification.order_selection import (
    PLATEAU,
    cancelled_poles,
    effective,
    equal_delays,
    lag_one,
)
from backlash_ros.core.identification.response import response_of
from backlash_ros.core.identification.result import Details, HeldOut, Identification, Options
from backlash_ros.core.identification.structure import TINY, VAGUE, Model, Samples, fitted, moved_to
from backlash_ros.core.identification.structure_search import StructureSearch, Units, observed_of
from backlash_ros.core.identification.verdict import CERTAIN, Findings, judge
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.samples import frequencies_of

Array = NDArray[np.float64]

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


def described(
    s: StructureSearch, given: Identification, options: Options, units: Units,
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
    observed = observed_of(s.samples, best, units)
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


def as_a_gain(
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
    gain = described(
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
