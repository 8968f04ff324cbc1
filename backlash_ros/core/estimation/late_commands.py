"""Decides which of two commands acted in an interval, where the newer one may have come too late.

If the command that is not in the record acted, it would add s to y. With residuals r, this raises
the log-likelihood by (s.r - s.s / 2) / sigma^2 (A. S. Willsky, H. L. Jones, IEEE Trans. Automatic
Control 21 (1976)). Prior odds, after k of n commands were late: k + 1/2 to n - k - 1/2 (Jeffreys).
The likeliest swap is made first, and the rest compared again, until none is likely; as two late
commands soon after each other look like one between them, pairs are compared, too.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.explanations import Setup, afresh
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import basis, lfilter, log_jeffreys
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window

NEWEST = 300  # samples within which two commands are compared as a pair


class Acting(NamedTuple):
    """Which command acts in each interval: v, the other one, and play output p, residuals of y, all
    (N,), and which of the open intervals are swapped (M,)."""

    v: Array
    other: Array
    p: Array
    residual: Array
    swapped: NDArray[np.bool_]


class OpenIntervals:
    """The intervals of a record, from sample `since` on, in which another command may have acted.

    at: their indices (M,). newest: which of them are compared as pairs. start: with the commands
    `already` swapped. Of residuals only what the unknowns of the fit cannot explain counts.
    """

    def __init__(
        self, setup: Setup, record: Window, fit: WindowFit, already: frozenset[int],
        older: Prior | None, since: int = 0,
    ) -> None:
        every = np.flatnonzero(np.isfinite(record.other))
        self.at, self._count = every[every >= since - record.first], len(every)
        problem, self._fit = setup.problem(record, older), fit
        self._reach = settings.ROWS if setup.family.integrates else setup.family.memory
        self._known, self._plant = problem.known.astype(np.float64), setup.family.at(fit.xi)
        self._q = basis(problem.jacobian(fit) * self._known[:, None])
        # Correlated residuals are mostly due to the very commands that are looked for.
        self._noise = max(fit.noise * (0.25 if fit.systematic else 1.0), problem.nominal,
                          problem.step_of_readings / sqrt(12.0))
        run, swapped = problem.at(fit), np.isin(record.first + self.at, list(already))
        self.start = Acting(record.v, record.other, run.p, run.error, swapped)
        self._settled = len(record.places(already)) - int(swapped.sum())
        # Most swaps move p in one interval only: their effect is that of a unit pulse, scaled.
        pulse = self._moved(np.eye(1, self._reach)[0])
        self._squares = np.correlate(np.pad(self._known, (0, self._reach - 1)), pulse**2)[self.at]
        self._squares -= (self._along(self._q.T) ** 2).sum(axis=0)
        begin = max(len(record.v) - NEWEST, 0)
        self.newest = np.flatnonzero(self.at >= begin)
        pulses = self._moved(np.eye(len(record.v) - begin)[self.at[self.newest] - begin])
        pulses, q = pulses * self._known[begin:], self._q[begin:]
        self._products = pulses @ pulses.T - (pulses @ q) @ (pulses @ q).T

    def log_posterior(self, acting: Acting) -> float:
        rest = self._unexplained(acting)
        return self._prior_of(acting) - 0.5 * float(rest @ rest) / self._noise**2

    def swapped(self, acting: Acting, places: Sequence[int]) -> Acting:
        """The same with the other command in these of the open intervals."""
        v, other, p = acting.v.copy(), acting.other.copy(), acting.p
        residual, swapped = acting.residual.copy(), acting.swapped.copy()
        for i in places:
            k = int(self.at[i])
            residual[k:k + self._reach] -= self._added(k, v, other, p)
            v[k], other[k], swapped[i] = other[k], v[k], not swapped[i]
            p = play(v, self._fit.gap, self._fit.p0)
        return Acting(v, other, p, residual, swapped)

    def likeliest(self, acting: Acting, in_pairs: bool) -> list[int]:
        """The swap, or pair of swaps, that seems to gain most; none if none gains."""
        v, other, p, _, swapped = acting
        at, q, reach, gap = self.at, self._q, self._reach, self._fit.gap
        rest = self._unexplained(acting)
        swap_to = np.clip(np.append(self._fit.p0, p[:-1])[at], other[at], other[at] + gap)
        moved, after = swap_to - p[at], np.minimum(at + 1, len(v) - 1)
        gains = moved * self._along(rest) - 0.5 * moved**2 * self._squares
        on = np.clip(swap_to, v[after], v[after] + gap) != p[after]  # whether later p change, too
        for i in np.flatnonzero((moved != 0.0) & on):
            k = int(at[i])
            seen = self._added(k, v, other, p)
            explained = q[k:k + reach].T @ seen
            gains[i] = seen @ rest[k:k + reach] - 0.5 * (seen @ seen - explained @ explained)
        fewer, same, more = (self._prior_of(acting, count) for count in (-1, 0, 1))
        gains = gains / self._noise**2 + np.where(swapped, fewer, more) - same
        gains[moved == 0.0] = -inf
        each, by = np.where(on, -inf, gains)[self.newest], moved[self.newest] / self._noise
        pairs = np.add.outer(each, each) - np.outer(by, by) * self._products
        np.fill_diagonal(pairs, -inf)
        if in_pairs and pairs.max(initial=-inf) > max(gains.max(), 0.0):
            return [*map(int, self.newest[[*divmod(int(pairs.argmax()), len(pairs))]])]
        return [int(gains.argmax())] if gains.max() > 0.0 else []

    def _moved(self, p: Array) -> Array:
        """Change of y by this change of p, both (..., N)."""
        b, a = self._plant
        return lfilter(b, a, self._fit.m * p)

    def _along(self, values: Array) -> Array:
        """Sums of values (..., N) times what a unit pulse of p in each interval adds to y."""
        return self._moved(values[..., ::-1])[..., ::-1][..., self.at]

    def _added(self, k: int, v: Array, other: Array, p: Array) -> Array:
        """Change of y if the other command acts in interval k."""
        end = k + self._reach
        acting = np.append(other[k], v[k + 1:end])
        moved = play(acting, self._fit.gap, float(p[k - 1]) if k else self._fit.p0) - p[k:end]
        return self._moved(moved) * self._known[k:end]

    def _unexplained(self, acting: Acting) -> Array:
        return acting.residual - self._q @ (self._q.T @ acting.residual)

    def _prior_of(self, acting: Acting, more: int = 0) -> float:
        """Its log-prior with so many more commands swapped."""
        late = self._settled + int(acting.swapped.sum()) + more
        return log_jeffreys(max(late, 0), self._count)


def likelier(
    setup: Setup, record: Window, fit: WindowFit, already: frozenset[int], older: Prior | None,
    since: int = 0,
) -> tuple[Window, frozenset[int]]:
    """Swap commands from sample `since` on where the other one is likelier to have acted.

    already: samples swapped so far. Returns the record and all samples that are swapped in it.
    """
    if not record.between(since).is_open or fit.m <= 0.0 or fit.wiener:
        return record, already
    intervals = OpenIntervals(setup, record, fit, already, older, since)
    acting, newest = intervals.start, intervals.newest
    best = intervals.log_posterior(acting)
    for _ in range(200):  # at most this many times
        # A pair may gain less than it seems; one of three commands may have to be taken back first.
        back = [([i], True) for i in newest[acting.swapped[newest]].tolist()]
        for taken_back, in_pairs in [([], True), ([], False), *back]:
            there = intervals.swapped(acting, taken_back)
            there = intervals.swapped(there, intervals.likeliest(there, in_pairs))
            if (now := intervals.log_posterior(there)) > best + 1e-6:
                best, acting = now, there
                break
        else:
            break
    changed = acting.swapped != intervals.start.swapped
    found = frozenset((record.first + intervals.at[changed]).tolist())
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
    ahead = fit.evidence + log_jeffreys(late, open_) - rival.evidence - log_jeffreys(0, open_)
    if ahead < 0.0:
        record, fit, rival = record.swapped(swapped), rival, fit
        swapped -= frozenset(range(record.first, record.end))
    wider = rival.apart(fit)
    wider[:3, :3] += rival.crossings_cov
    wider /= 1.0 + exp(min(abs(ahead), 700.0))
    return record, replace(fit, spread=fit.spread + wider), swapped
