"""What a fit leaves: noise, beside the rounding of readings, or a disturbance of u that walks."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS, Problem
from backlash_ros.core.estimation.posterior import WindowFit


def with_intervals(p: Problem, f: WindowFit) -> WindowFit:
    """The finished fit, by intervals where readings have a step that the noise does not hide.

    The noise beside the rounding is the likeliest of a grid, but as large as leaves a
    reading near an edge of its interval for every unknown: fewer are no normal posterior.
    """
    step, unknowns = p.step_of_readings, len(f.x) + len(f.knots) + 1 + len(f.theta)
    largest = 0.25 * step
    edges = unknowns / max(float(p.at(f).weights.sum()), 1.0)
    least = min(step * max(1.0 / 64.0, edges), largest)
    if not step or f.m <= 0.0 or (not f.step and f.noise_std > 0.75 * step):
        return p.finished(f)

    def at(level: float, begin: WindowFit) -> WindowFit:
        return p.finished(p.fitted(replace(begin, step=step, noise_std=level), FEW_STEPS))

    first = max(min(f.noise_std if f.step else largest, largest), least)
    best = at(first, f)
    for factor in (0.5, 2.0):
        if best.noise_std < first:
            break
        while least <= factor * best.noise_std <= largest:
            other = at(factor * best.noise_std, best)
            if other.evidence <= best.evidence:
                break
            best = other
    return best if best.left.rms < 1.5 * f.noise else p.finished(p.fitted(f.without_intervals))


def with_walk(p: Problem, f: WindowFit, least: float) -> WindowFit:
    """The fit, or one where u walks as well if that explains why residuals are correlated.

    One that walks already is compared with one that does not in the same way. least: walk that is
    configured, per square root of a sample.
    """
    shares = (0.005, 0.02, 0.08)  # of m times the gap, by which u may walk over the record
    best = f
    begin = replace(f.without_intervals, knots=np.zeros(0), walk_std=least)
    if f.walk_std != least:
        best = with_intervals(p, p.fitted(begin))
    if not best.valid or not best.systematic:
        return best
    for walk_std in (share * f.m * f.gap / sqrt(len(p.v)) for share in shares):
        if walk_std > least:
            g = with_intervals(p, p.fitted(replace(begin, walk_std=walk_std), FIRST_STEPS))
            needed = 0.0 if best.walk_std > least else settings.FAR_BEHIND
            # Readings of which the walk leaves a correlated rest count as fewer.
            if g.valid and g.evidence - best.evidence > needed * g.inflation:
                best = g
    return best
