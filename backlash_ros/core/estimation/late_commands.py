"""Decides which of two commands acted in an interval, where the newer one may have come too late.

If the command that is not in the record acted, it would add s to y. With residuals r, this raises
the log-likelihood by (s.r - s.s / 2) / sigma^2 (A. S. Willsky, H. L. Jones, IEEE Trans. Automatic
Control 21 (1976)). Prior odds, after k of n commands were late: k + 1/2 to n - k - 1/2 (Jeffreys).
The likeliest swap is made first, and the rest compared again, until none is likely.
"""

from dataclasses import replace
from math import exp, log, sqrt

import numpy as np

from backlash_ros.core.estimation.explanations import Setup, afresh, apart
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import basis, lfilter
from backlash_ros.core.plant.transfer_function import ON_CIRCLE, Array, memory_of
from backlash_ros.core.window import Window


def likelier(
    problem: Problem, fit: WindowFit, record: Window, since: int, back: frozenset[int],
) -> tuple[Window, frozenset[int]]:
    """Swap commands from sample `since` on where the other one is likelier to have acted.

    back: samples swapped so far. Returns the record and all samples that are swapped in it.
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
    q = basis(problem.jacobian(fit) * known[:, None])
    residual = problem.at(fit).error.copy()
    # Correlated residuals are mostly due to the very commands that are looked for.
    noise = max(fit.noise * (0.25 if fit.systematic else 1.0), problem.nominal,
                problem.step_of_readings / sqrt(12.0))
    v, other = record.v.copy(), record.other.copy()
    swapped = before = np.isin(record.first + open_, list(back))

    def added(k: int) -> Array:
        """Change of y if the other command acts in interval k."""
        acting = np.append(other[k], v[k + 1:k + reach])
        moved = play(acting, fit.gap, float(p[k - 1]) if k else fit.p0) - p[k:k + reach]
        return lfilter(b, a, fit.m * moved) * known[k:k + reach]

    def sums(values: Array, weights: Array) -> Array:
        padded = np.pad(values[open_[0]:], (0, reach - 1))
        return np.asarray(np.correlate(padded, weights)[open_ - open_[0]])

    # Most swaps move p in one interval only: their effect is that of a unit pulse, scaled.
    pulse = lfilter(b, a, fit.m * (np.arange(reach) == 0.0))
    squares = sums(known, pulse**2) - sum(sums(column, pulse)**2 for column in q.T)
    for _ in range(200):  # at most this many swaps at once
        p = play(v, fit.gap, fit.p0)
        more, less = (log(max(count - k, 1) - 0.5) - log(k + 0.5) for k in (late, max(late - 1, 0)))
        rest = residual - q @ (q.T @ residual)
        at = np.clip(np.append(fit.p0, p[:-1])[open_], other[open_], other[open_] + fit.gap)
        moved, after = at - p[open_], np.minimum(open_ + 1, len(v) - 1)
        gains = moved * sums(rest, pulse) - 0.5 * moved**2 * squares
        on = np.clip(at, v[after], v[after] + fit.gap) != p[after]  # whether later p change, too
        for i in np.flatnonzero((moved != 0.0) & on):
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


def weighed(
    setup: Setup, record: Window, fit: WindowFit, swapped: frozenset[int], older: Prior | None,
) -> tuple[Window, WindowFit, frozenset[int]]:
    """Choose between the swapped record and the one that was sent, as a wrong fit makes commands
    look late. Returns record, fit and swapped samples; the other fit adds to the spread."""
    from scipy.special import betaln  # late: 31 MB that only fits need

    late, open_ = len(record.places(swapped)), np.isfinite(record.other).sum()
    rival = afresh(setup, record.swapped(swapped), None, older, also=fit) if late else None
    if rival is None or not rival.valid:
        return record, fit, swapped
    odds = float(betaln(late + 0.5, open_ - late + 0.5) - betaln(0.5, open_ + 0.5))
    ahead = fit.evidence + odds - rival.evidence
    if ahead < 0.0:
        record, fit, rival = record.swapped(swapped), rival, fit
        swapped -= frozenset(range(record.first, record.end))
    wider = apart(rival, fit)
    wider[:3, :3] += rival.crossings_cov
    wider /= 1.0 + exp(min(abs(ahead), 700.0))
    return record, replace(fit, spread=fit.spread + wider), swapped
