"""Which of two commands acted over an interval, where the time of arrival leaves that open.

Where the other one acted, u was another one until the play output is the same again, and y moves by
what G makes of that. With s of that in the residuals r of the fit, the other command is

    (s.r - s.s / 2) / sigma^2

more likely, less the log-odds against it; of both r and s, what other unknowns may explain is left
out. The likeliest is believed first, and the rest compared again, until none is likely. How often
commands are late is unknown: with Jeffreys' prior of that share, k of n that were late make the
odds of one more (k + 1/2) to (n - k - 1/2), so that one alone needs much evidence.

Reference: A. S. Willsky, H. L. Jones, A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems, IEEE Trans. Automatic Control 21 (1976) 108-112.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.explanations import Window
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.play import play
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import memory_of

Array = NDArray[np.float64]


def likelier(problem: Problem, fit: WindowFit, record: Window, since: int, back: frozenset[int],
             ) -> tuple[Window, frozenset[int]]:
    """The record as it is likelier from `since` on, and where in it the other command acted.

    problem: of the record. back: numbers of the samples over which the other one acts already, so
    that its odds are the reverse.
    """
    own_noise = 0.25  # of correlated residuals: what is noise of readings
    open_ = np.flatnonzero(np.isfinite(record.other))
    count, late = len(open_), len(record.places(back))
    open_ = open_[open_ >= since - record.first]
    if not len(open_) or fit.m <= 0.0:
        return record, back
    b, a = problem.family.at(fit.xi)
    modes = np.abs(np.roots(a))
    reach = memory_of(float(modes[modes < 1.0 - ON_CIRCLE].max(initial=0.0)))
    chosen: set[int] = set()
    y = problem.output(fit)
    known = problem.known.astype(np.float64)
    jacobian = problem.jacobian(fit) * known[:, None]
    size = np.maximum(np.abs(jacobian).max(axis=0), 1e-300)
    q = np.linalg.qr(jacobian / size)[0]
    residual = (problem.y - y) * known
    # Correlated residuals are for the most part made by the commands that are looked for.
    noise = fit.noise * (own_noise if fit.systematic else 1.0)
    noise = max(noise, problem.nominal, problem.step_of_readings / sqrt(12.0))
    v, other = record.v.copy(), record.other.copy()
    p = play(v, fit.gap, fit.p0)
    for _ in range(200):  # swaps of one look
        more, less = (log(max(count - k, 1) - 0.5) - log(k + 0.5) for k in (late, max(late - 1, 0)))
        rest = residual - q @ (q.T @ residual)
        best, place, change = 0.0, -1, residual[:0]
        for k in open_.tolist():
            moved = _change(v, other, p, k, reach, fit)
            if not moved.any():
                continue
            s = lfilter(b, a, fit.m * moved)
            end = k + len(s)
            seen = s * known[k:end]
            explained = q[k:end].T @ seen
            gain = float(seen @ rest[k:end] - 0.5 * (seen @ seen - explained @ explained))
            gain /= noise**2
            gain -= more if (record.first + k in back) == (k in chosen) else -less
            if gain > best:
                best, place, change = gain, k, s
        if place < 0:
            break
        late += 1 if (record.first + place in back) == (place in chosen) else -1
        v[place], other[place] = other[place], v[place]
        chosen ^= {place}
        end = place + len(change)
        residual[place:end] -= change * known[place:end]
        p = play(v, fit.gap, fit.p0)
    found = frozenset(record.first + k for k in chosen)
    return record.swapped(found), back ^ found


def _change(v: Array, other: Array, p: Array, k: int, reach: int, fit: WindowFit) -> Array:
    """By how much p would be another one from sample k on, were the other command to act there."""
    end = min(k + reach, len(v))
    acting = v[k:end].copy()
    acting[0] = other[k]
    return play(acting, fit.gap, float(p[k - 1]) if k else fit.p0) - p[k:end]
