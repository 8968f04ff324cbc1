"""Decides which of two commands acted in each interval where the newer one may have come too late.

Each sequence of decisions is a hypothesis with a recursive least squares of its own, linearized at
a fit: what it predicts has Student-t densities, the noise being integrated out. Prior odds, after k
of n commands were late: k + 1/2 to n - k + 1/2 (Jeffreys). At each sample the likeliest go on: the
M-algorithm (J. B. Anderson, S. Mohan, IEEE Trans. Communications 32 (1984) 169-176).
"""

from dataclasses import replace
from math import exp, inf, lgamma, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.explanations import Setup, afresh, apart
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.numerics import lfilter, triangle
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window

KEPT, BEHIND = 50, 40.0  # how many hypotheses go on, and how far behind the likeliest [nats]
NEWEST = 4 * settings.ROWS  # samples within which decisions are open


class Hypotheses(NamedTuple):
    """What H hypotheses say after a sample; the first one is that of the record as it is.

    value: log-probability (H,). late: number of late commands (H,). p: play output (H,). moved: p
    minus that of the record, filtered by 1 / A, newest samples first (H, T). unknowns: minus those
    of the fit (H, P). root: square root of their covariance over the noise variance (H, P, P).
    squares: of the errors of all predictions (H,).
    """

    value: Array
    late: Array
    p: Array
    moved: Array
    unknowns: Array
    root: Array
    squares: Array


class Decisions:
    """The decisions in a record from its sample `begin` on; swapped: where it is late now (N,)."""

    def __init__(
        self, setup: Setup, record: Window, fit: WindowFit, swapped: NDArray[np.bool_],
        older: Prior | None, begin: int,
    ) -> None:
        problem = setup.problem(record, older)
        self._record, self._fit, self._run, self._begin = record, fit, problem.at(fit), begin
        self._jacobian, self._swapped = problem.jacobian(fit), swapped
        self._weights, self._open = self._run.weights * problem.known, np.isfinite(record.other)
        self._a, self._b = np.array(self._run.a), np.array(self._run.b)
        self._of_b = setup.family.slopes(fit.xi)[0]
        self._m_at = self._jacobian.shape[1] - setup.family.count - 3
        self._noise_std = max(problem.nominal, problem.step_of_readings / sqrt(12.0))
        # Less than this cannot outweigh the prior odds.
        pulse = lfilter(self._b, self._a, fit.m * np.eye(1, len(record.v))[0])
        gains = 0.5 * (record.v - record.other) ** 2 * float(pulse @ pulse) / self._noise_std**2
        self._asked = self._open & (gains > log(self._open.sum() + 1.0))
        # Prior rows of the unknowns, minus those of the fit; weak ones for m, o and xi.
        rows, unknowns = problem.rows(fit)[len(record.v):], problem.unknowns(fit)
        weak = np.eye(len(unknowns) + 1)[self._m_at:]
        weak[3:-1, -1] = -fit.theta[3:]
        stds = [fit.m, fit.m * np.ptp(record.v), inf, *[max(fit.scale, 1.0)] * len(fit.xi), inf]
        weak /= np.array(stds)[:, None]
        rows = np.column_stack([rows[:, :-1], rows[:, -1] - rows[:, :-1] @ unknowns])
        self._prior = self._noise_std * np.vstack([rows, weak])

    def likeliest(self) -> NDArray[np.bool_]:
        """Which commands to swap, (N,)."""
        count, begin, run, w = len(self._record.v), self._begin, self._run, self._weights
        rows = np.column_stack([self._jacobian, run.error])[:begin] * np.sqrt(w[:begin])[:, None]
        r = triangle(np.vstack([rows, self._prior]))
        root = np.linalg.inv(r[:-1, :-1])
        now = Hypotheses(*(np.array([each]) for each in (
            0.0, self._swapped[:begin].sum(), run.p[begin - 1] if begin else self._fit.p0,
            np.zeros(len(self._a)), root @ r[:-1, -1], root, r[-1, -1] ** 2 + self._noise_std**2)))
        readings, decided = 1.0 + np.cumsum(w) - w, np.cumsum(self._open) - self._open
        ways = list[tuple[NDArray[np.intp], NDArray[np.bool_]]]()
        for k in range(begin, count):
            now, parents, other = self._decided(now, k, float(decided[k]))
            now = self._heard(now, k, float(readings[k]))
            best = np.argsort(-now.value, kind='stable')[:KEPT]
            best = best[now.value[best] > now.value[best[0]] - BEHIND]
            best = np.append(0, best[best > 0])  # the record itself is always among them
            now = Hypotheses(*(each[best] for each in now))
            ways.append((parents[best], other[best]))
        swap, at = np.zeros(count, np.bool_), int(now.value.argmax())
        for k in range(count - 1, begin - 1, -1):
            parents, other = ways.pop()
            swap[k], at = other[at], parents[at]
        return swap

    def _decided(
        self, now: Hypotheses, k: int, decided: float,
    ) -> tuple[Hypotheses, NDArray[np.intp], NDArray[np.bool_]]:
        """All, with both commands in interval k, after so many decisions; their parents, and which
        have the other command."""
        gap, v, v_other = self._fit.gap, self._record.v[k], self._record.other[k]
        parents: NDArray[np.intp] = np.arange(len(now.p))
        p: Array = np.clip(now.p, v, v + gap)
        other: NDArray[np.bool_] = np.zeros(len(p), np.bool_)
        chance: Array = np.zeros(len(p))
        if self._asked[k]:
            p_other = np.clip(now.p, v_other, v_other + gap)
            differ = p_other != p
            share = (now.late + 0.5) / (decided + 1.0)  # of late commands
            odds = np.log(np.stack([1.0 - share, share]))[::-1 if self._swapped[k] else 1, differ]
            chance[differ] = odds[0]
            parents, p = np.append(parents, parents[differ]), np.append(p, p_other[differ])
            other, chance = np.append(other, differ[differ]), np.append(chance, odds[1])
        before = Hypotheses(*(each[parents] for each in now))
        newest = p - self._run.p[k] - before.moved[:, :-1] @ self._a[1:]
        late = before.late + ((other != self._swapped[k]) & self._open[k])
        return before._replace(
            value=before.value + chance, late=late, p=p,
            moved=np.column_stack([newest, before.moved[:, :-1]])), parents, other

    def _heard(self, now: Hypotheses, k: int, readings: float) -> Hypotheses:
        """The hypotheses after y(k); readings: number of those before."""
        weight, m, taps = self._weights[k], self._fit.m, now.moved[:, :len(self._b)]
        if not weight:
            return now
        by_p, rows = taps @ self._b, np.repeat(self._jacobian[k:k + 1], len(taps), axis=0)
        rows[:, self._m_at] += by_p
        rows[:, self._m_at + 3:] += m * taps @ self._of_b.T
        error = self._run.error[k] - m * by_p - (rows * now.unknowns).sum(axis=1)
        # Potter's filter: G. J. Bierman, Factorization Methods for Discrete Estimation (1977).
        seen = np.einsum('hij,hi->hj', now.root, rows)
        variance = 1.0 / weight + (seen**2).sum(axis=1)
        gain = (now.root @ seen[:, :, None])[:, :, 0] / variance[:, None]
        shorter = gain / (1.0 + np.sqrt(1.0 / (weight * variance)))[:, None]
        more = error**2 / variance
        density = np.log(variance * now.squares) + (readings + 1.0) * np.log1p(more / now.squares)
        return now._replace(
            value=now.value - 0.5 * density, unknowns=now.unknowns + gain * error[:, None],
            root=now.root - shorter[:, :, None] * seen[:, None, :], squares=now.squares + more)


def likelier(
    setup: Setup, record: Window, fit: WindowFit, already: frozenset[int], older: Prior | None,
    since: int = 0,
) -> tuple[Window, frozenset[int]]:
    """Swap commands from sample `since` on where the other one is likelier to have acted.

    already: samples swapped so far. Returns the record and all samples that are swapped in it.
    """
    since = max(since, record.end - NEWEST, record.first)
    if not record.between(since).is_open or fit.m <= 0.0:
        return record, already
    swapped = np.isin(np.arange(record.first, record.end), list(already))
    decisions = Decisions(setup, record, fit, swapped, older, since - record.first)
    found = frozenset((record.first + np.flatnonzero(decisions.likeliest())).tolist())
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
    a, b = late + 0.5, max(count - late, 0) + 0.5
    return lgamma(a) + lgamma(b) - lgamma(a + b)
