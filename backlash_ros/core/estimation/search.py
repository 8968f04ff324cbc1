"""Global search for starting points of a fit: evidence over a grid of gaps and initial positions.

Given a gap g and an initial p0, y is to first order linear in X, o, m, m xi and m times the error
of p0. So one QR gives the evidence of each of some 200 hypotheses; rows are averaged to some 1,500.
"""

from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation.settings import ROWS
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import bins_of, lfilter, sensitivities, state_responses
from backlash_ros.core.plant.transfer_function import Array, Family


class Hypothesis(NamedTuple):
    """A gap, p0 and the slope fitted with them, and their evidence; peak: a maximum over gaps."""

    evidence: float
    gap: float
    p0: float
    m: float
    peak: bool = False


def search(
    family: Family, v: Array, y: Array, noise_std: float, widest: float, xi: Array,
    smallest: float = 0.01,
) -> tuple[list[Hypothesis], float]:
    """Hypotheses, up to three local maxima over the gap first, and the evidence of a constant u.

    v, y: (N,), y nan where lost. widest: largest gap considered. xi: error of G (K,) around which G
    is linearized. smallest: smallest gap over the largest (swing of v, at most `widest`).
    """
    known, begins, (b, a) = np.isfinite(y), bins_of(v, ROWS), family.at(xi.tolist())
    readings = np.add.reduceat(known.astype(np.float64), begins)
    weights = (readings > 0.0) / np.sqrt(np.maximum(readings, 1.0))

    def averaged(columns: Array) -> Array:
        """Columns (..., N) summed over bins, each divided by the root of its number of readings."""
        return np.asarray(np.add.reduceat(columns * known, begins, axis=-1) * weights)

    common = np.vstack([state_responses(a, len(v)), lfilter(b, a, np.ones(len(v)))])
    q = np.linalg.qr(averaged(common).T)[0]
    freedom = max(q.shape[0] - q.shape[1], 1)

    def rest(columns: Array) -> Array:
        """Columns (..., R) minus their projection on X and o."""
        return np.asarray(columns - (columns @ q) @ q.T)

    def value(squares: Array) -> Array:
        """Evidence with this residual sum of squares, the noise integrated out."""
        return np.asarray(-0.5 * freedom * np.log((squares + noise_std**2) / len(q)))

    y_rest = rest(averaged(np.where(known, y, 0.0)))

    def compared(gaps: Array) -> list[Hypothesis]:
        """The best p0 for each gap."""
        shares: Array = np.arange(5) / 4.0  # positions of p0 within the gap
        g, k = np.repeat(gaps, len(shares)), family.count
        before = v[0] + np.tile(shares, len(gaps)) * g
        p = play(v, g, before)
        begun = np.logical_and.accumulate(p == p[:, :1], axis=1).astype(np.float64)
        # Only motion of u depends on xi; its constant part belongs to o.
        move = lfilter([1.0], a, p - p[:, :1])
        y_over_a = lfilter([1.0], a, lfilter(b, [1.0], move))
        of_play = averaged(lfilter(b, [1.0], lfilter([1.0], a, np.stack([p, begun], 1))))
        of_xi = averaged(sensitivities(family, xi.tolist(), move, y_over_a))
        columns = rest(np.concatenate([of_play, of_xi], axis=1))
        target = np.broadcast_to(y_rest, (len(g), 1, len(y_rest)))
        stack = np.concatenate([columns, target], axis=1).transpose(0, 2, 1)
        r = np.asarray(np.linalg.qr(stack, mode='r'))
        # Standard deviation of the noise in units of v.
        noise = np.sqrt((r[:, -1, -1] ** 2 + noise_std**2) / freedom) \
            / (np.abs(r[:, 0, -1] / r[:, 0, 0]) + 1e-30)
        evidence = np.full(len(g), -inf)
        for scale in (0.03, 0.3, 1.0) if k else (1.0,):  # values of s
            # p0 may be anywhere within the gap.
            prior = np.column_stack([noise * 12.0**0.5 / g, *[noise / scale] * k])
            of_prior = prior[:, :, None] * np.eye(1 + k, 3 + k, 1)
            s = np.asarray(np.linalg.qr(np.concatenate([r, of_prior], axis=1), mode='r'))
            volume = np.log(prior / (np.abs(np.diagonal(s, 0, 1, 2)[:, 1:-1]) + 1e-300)).sum(axis=1)
            # p0 lies within the gap: this constraint may cost likelihood.
            off = s[:, 1, -1] / s[:, 1, 1]
            m = (s[:, 0, -1] - s[:, 0, 1] * off) / s[:, 0, 0]
            p0 = np.clip(before + off / m, v[0], v[0] + g)
            squares = s[:, -1, -1] ** 2 + (s[:, 1, 1] * (off - m * (p0 - before))) ** 2
            evidence = np.maximum(evidence, value(squares) + volume - 0.5 * scale**2)
        best = evidence.reshape(len(gaps), -1).argmax(axis=1) + np.arange(0, len(g), len(shares))
        return [Hypothesis(*one) for one in np.column_stack([evidence, g, p0, m])[best].tolist()]

    top = min(float(np.ptp(v)), widest)
    gaps: Array = np.append(1e-9 * top, np.geomspace(smallest * top, top, 32))
    # The first is practically none. Evaluated in parts that fit into memory.
    parts = np.array_split(gaps, 1 + len(gaps) * len(v) * (1 + family.count) // 500_000)
    found = [h for part in parts for h in compared(part) if isfinite(h.evidence)]
    e = [-inf, *(h.evidence for h in found), -inf]
    peaks = sorted((h for k, h in enumerate(found) if e[k] < e[k + 1] > e[k + 2]), reverse=True)[:3]
    rest_of_all = sorted({*found} - {*peaks}, reverse=True)
    return [*(h._replace(peak=True) for h in peaks), *rest_of_all], float(value(y_rest @ y_rest))
