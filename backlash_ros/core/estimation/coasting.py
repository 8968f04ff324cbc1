"""Whether a load runs on within the gap, by a score test: no play holds it there then.

The way that a load would run on, with the speed that it had when it left its side and as far as the
other side, is one more column of the fit. Its coefficient kappa is 0 where the load stays and 1
where nothing brakes it; a score test needs no fit with it (C. R. Rao, Proc. Cambridge Philosophical
Society 44 (1948) 50-57).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]


def coasts(problem: Problem, fit: WindowFit, known: Array | None = None) -> bool:
    """Whether the load runs on within the gap: that of the fit, or the one known before.

    known: m, c_r, c_l (3,). The fit of a load that coasts may have next to no gap.
    """
    if known is not None:
        m, c_r, c_l = known.tolist()
        theta = np.concatenate([[m, m * c_r, c_r - c_l], fit.theta[3:]])
        there = replace(fit, theta=theta, p0=float(problem.v[0]) + 0.5 * (c_r - c_l), x=fit.x * 0.0)
        there = replace(there, x=problem.state(there))
        rms = float(np.sqrt(np.nanmean(problem.residual(there) ** 2)))
        if coasts(problem, replace(there, rms=rms)):
            return True
    p, _ = problem.input(fit)
    b, a = problem.family.at(fit.xi)
    column = lfilter(b, a, fit.m * _run_on(problem.v, p, fit.gap))
    seen = problem.known
    y = problem.output(fit)
    others = problem.jacobian(fit)[seen]
    q = np.linalg.qr(others / np.maximum(np.abs(others).max(axis=0), 1e-300))[0]
    s = column[seen] - q @ (q.T @ column[seen])
    squares = float(s @ s)
    if squares <= 1e-12 * float(column @ column):
        return False
    kappa = float(s @ (problem.y - y)[seen]) / squares
    # Over its standard deviation as if residuals were white: they are far from that.
    return kappa > 0.15 and kappa * squares**0.5 / max(fit.noise, fit.rms) > 8.0


def _run_on(v: Array, p: Array, gap: float) -> Array:
    """How far a load that nothing brakes is from p (N,): 0 while a side is engaged."""
    out = [0.0]
    away = speed = 0.0
    held = p.tolist()
    for k in range(1, len(held)):
        move = held[k] - held[k - 1]
        if move:
            away, speed = 0.0, move
        else:
            low, high = v[k] - held[k], v[k] + gap - held[k]  # where the sides are
            away = min(max(away + speed, low), high)
        out.append(away)
    return np.array(out)
