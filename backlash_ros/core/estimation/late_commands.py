"""Decides which of two commands acted in an interval, where the newer one may have come too late.

If the command that is not in the record acted, it would add s to y. With residuals r, this raises
the log-likelihood by (s.r - s.s / 2) / sigma^2 (A. S. Willsky, H. L. Jones, IEEE Trans. Automatic
Control 21 (1976)). Prior odds, after k of n commands were late: k + 1/2 to n - k - 1/2 (Jeffreys).
The likeliest swap is made first, and the rest compared again, until none is likely; as two late
commands soon after each other look like one between them, pairs are compared, too.
"""

from collections.abc import Iterable
from dataclasses import replace
from math import exp, inf, sqrt

import numpy as np

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.explanations import Setup, afresh, apart
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import basis, lfilter
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window

NEWEST = 300  # samples within which two commands are compared as a pair


def likelier(
    setup: Setup, record: Window, fit: WindowFit, already: frozenset[int], older: Prior | None,
    since: int = 0,
) -> tuple[Window, frozenset[int]]:
    """Swap commands from sample `since` on where the other one is likelier to have acted.

    already: samples swapped so far. Returns the record and all samples that are swapped in it.
    """
    every = np.flatnonzero(np.isfinite(record.other))
    open_, count = every[every >= since - record.first], len(every)
    if not len(open_) or fit.m <= 0.0:
        return record, already
    problem, (b, a) = setup.problem(record, older), setup.family.at(fit.xi)
    reach = settings.ROWS if setup.family.integrates else setup.family.memory
    known = problem.known.astype(np.float64)
    q = basis(problem.jacobian(fit) * known[:, None])
    residual = problem.at(fit).error.copy()
    # Correlated residuals are mostly due to the very commands that are looked for.
    noise = max(fit.noise * (0.25 if fit.systematic else 1.0), problem.nominal,
                problem.step_of_readings / sqrt(12.0))
    v, other = record.v.copy(), record.other.copy()
    before = np.isin(record.first + open_, list(already))
    swapped, settled = before.copy(), len(record.places(already)) - int(before.sum())

    def added(k: int, p: Array) -> Array:
        """Change of y if the other command acts in interval k."""
        acting = np.append(other[k], v[k + 1:k + reach])
        moved = play(acting, fit.gap, float(p[k - 1]) if k else fit.p0) - p[k:k + reach]
        return lfilter(b, a, fit.m * moved) * known[k:k + reach]

    def along(values: Array) -> Array:
        """Sums of values (..., N) times what a unit pulse of p in each interval adds to y."""
        return fit.m * lfilter(b, a, values[..., ::-1])[..., ::-1][..., open_]

    # Most swaps move p in one interval only: their effect is that of a unit pulse, scaled.
    pulse = lfilter(b, a, fit.m * (np.arange(reach) == 0.0))
    squares = np.correlate(np.pad(known, (0, reach - 1)), pulse**2)[open_]
    squares -= (along(q.T) ** 2).sum(axis=0)
    newest = np.flatnonzero(open_ >= (tail := max(len(v) - NEWEST, 0)))
    pulses = lfilter(b, a, fit.m * np.eye(len(v) - tail)[open_[newest] - tail]) * known[tail:]
    products = pulses @ pulses.T - (pulses @ q[tail:]) @ (pulses @ q[tail:]).T

    def log_posterior() -> float:
        rest = residual - q @ (q.T @ residual)
        return _log_prior(settled + int(swapped.sum()), count) - 0.5 * float(rest @ rest) / noise**2

    def likeliest(in_pairs: bool) -> list[int]:
        """The swap, or pair of swaps, that seems to gain most; none if none gains."""
        p, late = play(v, fit.gap, fit.p0), settled + int(swapped.sum())
        fewer, same, more = (_log_prior(k, count) for k in (max(late - 1, 0), late, late + 1))
        rest = residual - q @ (q.T @ residual)
        at = np.clip(np.append(fit.p0, p[:-1])[open_], other[open_], other[open_] + fit.gap)
        moved, after = at - p[open_], np.minimum(open_ + 1, len(v) - 1)
        gains = moved * along(rest) - 0.5 * moved**2 * squares
        on = np.clip(at, v[after], v[after] + fit.gap) != p[after]  # whether later p change, too
        for i in np.flatnonzero((moved != 0.0) & on):
            k = int(open_[i])
            seen = added(k, p)
            explained = q[k:k + reach].T @ seen
            gains[i] = seen @ rest[k:k + reach] - 0.5 * (seen @ seen - explained @ explained)
        gains = gains / noise**2 + np.where(swapped, fewer, more) - same
        gains[moved == 0.0] = -inf
        each, by = np.where(on, -inf, gains)[newest], moved[newest] / noise
        pairs = np.add.outer(each, each) - np.outer(by, by) * products
        np.fill_diagonal(pairs, -inf)
        if in_pairs and pairs.max(initial=-inf) > max(gains.max(), 0.0):
            return [*map(int, newest[[*divmod(int(pairs.argmax()), len(pairs))]])]
        return [int(gains.argmax())] if gains.max() > 0.0 else []

    def swap(places: Iterable[int]) -> None:
        for i in places:
            k = int(open_[i])
            residual[k:k + reach] -= added(k, play(v, fit.gap, fit.p0))
            v[k], other[k], swapped[i] = other[k], v[k], not swapped[i]

    best = log_posterior()
    for _ in range(200):  # at most this many times
        # A pair may gain less than it seems; one of three commands may have to be taken back first.
        back = [([i], True) for i in newest[swapped[newest]].tolist()]
        for taken_back, in_pairs in [([], True), ([], False), *back]:
            as_it_was = residual.copy(), v.copy(), other.copy(), swapped.copy()
            swap(taken_back)
            swap(likeliest(in_pairs))
            if (now := log_posterior()) > best + 1e-6:
                best = now
                break
            residual, v, other, swapped = as_it_was
        else:
            break
    found = frozenset((record.first + open_[swapped != before]).tolist())
    return record.swapped(found), already ^ found


def weighed(
    setup: Setup, record: Window, fit: WindowFit, swapped: frozenset[int], older: Prior | None,
) -> tuple[Window, WindowFit, frozenset[int]]:
    """Choose between the swapped record and the one that was sent, as a wrong fit makes commands
    look late. Returns record, fit and swapped samples; the other fit adds to the spread."""
    late, open_ = len(record.places(swapped)), int(np.isfinite(record.other).sum())
    rival = afresh(setup, record.swapped(swapped), None, older, also=fit) if late else None
    if rival is None or not rival.valid:
        return record, fit, swapped
    ahead = fit.evidence + _log_prior(late, open_) - rival.evidence - _log_prior(0, open_)
    if ahead < 0.0:
        record, fit, rival = record.swapped(swapped), rival, fit
        swapped -= frozenset(range(record.first, record.end))
    wider = apart(rival, fit)
    wider[:3, :3] += rival.crossings_cov
    wider /= 1.0 + exp(min(abs(ahead), 700.0))
    return record, replace(fit, spread=fit.spread + wider), swapped


def _log_prior(late: int, count: int) -> float:
    """Logarithm of the prior probability that just these of `count` commands were late."""
    from scipy.special import betaln  # late: 31 MB that only fits need

    return float(betaln(late + 0.5, max(count - late, 0) + 0.5))
