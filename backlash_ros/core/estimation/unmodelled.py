"""Detects from residuals what the model lacks: a load that coasts, a random walk of u.

A load that nothing holds in the gap coasts at the speed at which it left its side. This is tested
as one more column of the fit, whose coefficient kappa is 0 if the load stays and 1 if nothing
brakes it: a score test (C. R. Rao, Proc. Cambridge Philosophical Society 44 (1948)).
"""

from dataclasses import replace
from math import sqrt

import numpy as np

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.fit import FIRST_STEPS, Problem
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.backlash import coasted
from backlash_ros.core.plant.numerics import basis, lfilter
from backlash_ros.core.plant.transfer_function import Array


def coasts(problem: Problem, fit: WindowFit, known: Array | None = None) -> bool:
    """Whether residuals are correlated because the load coasts within the gap: that of the fit, or
    of earlier m, c_r, c_l `known` (3,), as with coasting a fit may find next to no gap."""
    named = 8.0  # least kappa over its standard deviation; high, as residuals are far from white
    matters = 2e-3  # least unexplained motion over the gap; quantization of slow motion leaves less
    if not (fit.m > 0.0 and fit.left.turns and fit.systematic and fit.unexplained > matters):
        return False
    tested = [as_known(problem, fit.crossings, fit) if fit.wiener else fit]
    tested += [] if known is None else [as_known(problem, known, fit)]
    return any(coasting_score(problem, f) > named for f in tested)


def as_known(problem: Problem, known: Array, fit: WindowFit) -> WindowFit:
    """The fit with these m, c_r, c_l (3,) in place of its own, of a play before G."""
    m, c_r, c_l = known.tolist()
    theta = np.concatenate([[m, m * c_r, c_r - c_l], fit.theta[3:]])
    p0 = float(problem.v[0]) + 0.5 * (c_r - c_l)
    return problem.finished(problem.begun(replace(fit, theta=theta, p0=p0, wiener=False)))


def coasting_score(problem: Problem, fit: WindowFit) -> float:
    """kappa over its standard deviation for white residuals; 0 for a small kappa."""
    b, a = problem.family.at(fit.xi)
    beyond = coasted(problem.v, problem.at(fit).p, fit.gap)
    column = lfilter(b, a, fit.m * beyond)[problem.known]
    q = basis(problem.jacobian(fit)[problem.known])
    s = column - q @ (q.T @ column)
    squares = float(s @ s)
    if squares <= 1e-12 * float(column @ column):
        return 0.0
    kappa = float(s @ problem.residual(fit)[problem.known]) / squares
    return kappa * squares**0.5 / max(fit.noise, fit.left.rms) if kappa > 0.15 else 0.0


def with_walk(problem: Problem, f: WindowFit, least: float) -> WindowFit:
    """The fit, or one with a larger random walk of u if that explains correlated residuals."""
    begin = f.without_intervals(least)
    best = f if f.walk_std == least else problem.with_intervals(problem.fitted(begin))
    if f.wiener or not best.valid or not best.systematic:  # friction and compliance are no walk
        return best
    seems_to_coast = coasting_score(problem, best) > settings.BY_CHANCE
    for share in (0.005, 0.02, 0.08):  # walk over the record, in units of m times the gap
        std = share * f.m * f.gap / sqrt(len(problem.v))
        if std > least:
            g = problem.with_intervals(problem.fitted(replace(begin, walk_std=std), FIRST_STEPS))
            needed = 0.0 if best.walk_std > least else settings.FAR_BEHIND
            # Fewer independent residuals: those of a first-order process; if a load coasts, one.
            rho = min(g.left.correlation, 0.999)
            fewer = g.inflation if seems_to_coast else (1.0 + rho) / (1.0 - rho)
            if g.valid and g.evidence - best.evidence > needed * fewer:
                best = g
    return best
