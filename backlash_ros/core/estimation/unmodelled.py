"""What a fit lacks, told from its residuals: a load that coasts, a walk of u, late commands.

A load that nothing holds in the gap runs on with the speed that it had when it left its side. That
is one more column of the fit; its coefficient kappa is 0 where the load stays and 1 where nothing
brakes it (C. R. Rao, Proc. Cambridge Philosophical Society 44 (1948)).

Where one of two commands may have acted over an interval, the other one would add s to y. With s in
the residuals r, it is (s.r - s.s / 2) / sigma^2 more likely, less the log-odds against it, by
Jeffreys' prior (k + 1/2) to (n - k - 1/2) after k of n were late (A. S. Willsky, H. L. Jones, IEEE
Trans. Automatic Control 21 (1976)). The likeliest is believed first, until none is likely.
"""

from dataclasses import replace
from math import log, sqrt

import numpy as np

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.fit import FIRST_STEPS, Problem, Window
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.backlash import clamp, play
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import ON_CIRCLE, Array, memory_of


def coasts(problem: Problem, fit: WindowFit, known: Array | None = None) -> bool:
    """Whether residuals are correlated because the load runs on within the gap.

    known: m, c_r, c_l (3,) from before, for the fit of a load that coasts may have next to no gap.
    """
    named = 8.0  # kappa over its deviation, as residuals are far from white
    if not (fit.m > 0.0 and fit.systematic):
        return False
    if known is not None:
        m, c_r, c_l = known.tolist()
        theta = np.concatenate([[m, m * c_r, c_r - c_l], fit.theta[3:]])
        p0 = float(problem.v[0]) + 0.5 * (c_r - c_l)
        there = problem.begun(replace(fit, theta=theta, p0=p0))
        if _runs_on(problem, problem.finished(there)) > named:
            return True
    return _runs_on(problem, fit) > named


def _runs_on(problem: Problem, fit: WindowFit) -> float:
    """kappa over its standard deviation, as if residuals were white; 0 for a small one."""
    v, p = problem.v, problem.at(fit).p
    beyond, speed = [0.0], 0.0  # how far a load that nothing brakes is from p
    for k, move in enumerate(np.diff(p).tolist(), 1):
        speed = move or speed
        # From one side, where it starts anew, to the other.
        away = 0.0 if move else clamp(beyond[-1] + speed, v[k] - p[k], v[k] + fit.gap - p[k])
        beyond.append(away)
    b, a = problem.family.at(fit.xi)
    column = lfilter(b, a, fit.m * np.array(beyond))[problem.known]
    q = _basis(problem.jacobian(fit)[problem.known])
    s = column - q @ (q.T @ column)
    squares = float(s @ s)
    if squares <= 1e-12 * float(column @ column):
        return 0.0
    kappa = float(s @ problem.residual(fit)[problem.known]) / squares
    return kappa * squares**0.5 / max(fit.noise, fit.left.rms) if kappa > 0.15 else 0.0


def with_walk(problem: Problem, f: WindowFit, least: float) -> WindowFit:
    """The fit, or one with a larger walk of u if that explains correlated residuals."""
    best, begin = f, replace(f.without_intervals, knots=np.zeros(0), walk_std=least)
    if f.walk_std != least:
        best = problem.with_intervals(problem.fitted(begin))
    if not best.valid or not best.systematic:
        return best
    runs_on = _runs_on(problem, best) > settings.BY_CHANCE
    for share in (0.005, 0.02, 0.08):  # of m times the gap, by which u may walk over the record
        walk_std = share * f.m * f.gap / sqrt(len(problem.v))
        if walk_std > least:
            walks = replace(begin, walk_std=walk_std)
            g = problem.with_intervals(problem.fitted(walks, FIRST_STEPS))
            needed = 0.0 if best.walk_std > least else settings.FAR_BEHIND
            # Correlated readings count as a first-order process, or as one if a load coasts.
            rho = min(g.left.correlation, 0.999)
            fewer = g.inflation if runs_on else (1.0 + rho) / (1.0 - rho)
            if g.valid and g.evidence - best.evidence > needed * fewer:
                best = g
    return best


def likelier(
    problem: Problem, fit: WindowFit, record: Window, since: int, back: frozenset[int],
) -> tuple[Window, frozenset[int]]:
    """The record as it is likelier from `since` on, and where in it the other command acted.

    back: numbers of the samples over which it acts already.
    """
    open_ = np.flatnonzero(np.isfinite(record.other))
    count, late = len(open_), len(record.places(back))
    open_ = open_[open_ >= since - record.first]
    if not len(open_) or fit.m <= 0.0:
        return record, back
    b, a = problem.family.at(fit.xi)
    modes = np.abs(np.roots(a))
    reach = memory_of(float(modes[modes < 1.0 - ON_CIRCLE].max(initial=0.0)))
    known = problem.known.astype(np.float64)
    q = _basis(problem.jacobian(fit) * known[:, None])
    residual = problem.at(fit).error.copy()
    # Correlated residuals are for the most part made by the commands that are looked for.
    noise = max(fit.noise * (0.25 if fit.systematic else 1.0), problem.nominal,
                problem.step_of_readings / sqrt(12.0))
    v, other = record.v.copy(), record.other.copy()
    swapped = before = np.isin(record.first + open_, list(back))

    def added(k: int) -> Array:
        """What y has more, where the other command acts over interval k."""
        acting = np.append(other[k], v[k + 1:k + reach])
        moved = play(acting, fit.gap, float(p[k - 1]) if k else fit.p0) - p[k:k + reach]
        return lfilter(b, a, fit.m * moved) * known[k:k + reach]

    def sums(values: Array, weights: Array) -> Array:
        padded = np.pad(values[open_[0]:], (0, reach - 1))
        return np.asarray(np.correlate(padded, weights)[open_ - open_[0]])

    # Most move p for one interval alone: for these all is known from what a move by 1 adds.
    pulse = lfilter(b, a, fit.m * (np.arange(reach) == 0.0))
    squares = sums(known, pulse**2) - sum(sums(column, pulse)**2 for column in q.T)
    for _ in range(200):  # swaps of one look
        p = play(v, fit.gap, fit.p0)
        more, less = (log(max(count - k, 1) - 0.5) - log(k + 0.5) for k in (late, max(late - 1, 0)))
        rest = residual - q @ (q.T @ residual)
        at = _clamped(np.append(fit.p0, p[:-1])[open_], other[open_], fit.gap)
        moved, after = at - p[open_], np.minimum(open_ + 1, len(v) - 1)
        gains = moved * sums(rest, pulse) - 0.5 * moved**2 * squares
        for i in np.flatnonzero((moved != 0.0) & (_clamped(at, v[after], fit.gap) != p[after])):
            k = int(open_[i])
            seen = added(k)
            explained = q[k:k + reach].T @ seen
            gains[i] = seen @ rest[k:k + reach] - 0.5 * (seen @ seen - explained @ explained)
        gains = gains / noise**2 - np.where(swapped, -less, more)
        i = int(np.argmax(np.where(moved != 0.0, gains, 0.0)))
        if moved[i] == 0.0 or gains[i] <= 0.0:
            break
        k, late = int(open_[i]), late + (-1 if swapped[i] else 1)
        residual[k:k + reach] -= added(k)
        v[k], other[k] = other[k], v[k]
        swapped = swapped ^ (open_ == k)
    found = frozenset((record.first + open_[swapped != before]).tolist())
    return record.swapped(found), back ^ found


def _clamped(before: Array, v: Array, gap: float) -> Array:
    return np.asarray(np.minimum(np.maximum(before, v), v + gap))


def _basis(columns: Array) -> Array:
    return np.linalg.qr(columns / np.maximum(np.abs(columns).max(axis=0), 1e-300))[0]
