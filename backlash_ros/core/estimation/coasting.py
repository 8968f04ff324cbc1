"""Whether a load runs on within the gap, by a score test: no play holds it there then.

The way that a load would run on, with the speed that it had when it left its side and as far as the
other side, is one more column of the fit. Its coefficient kappa is 0 where the load stays and 1
where nothing brakes it; a score test needs no fit with it (C. R. Rao, Proc. Cambridge Philosophical
Society 44 (1948) 50-57).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

LEAST_KAPPA, LEAST_Z = 0.15, 8.0  # from which on a load coasts


class Coasting(NamedTuple):
    """The coefficient, and over its standard deviation as if residuals were white."""

    kappa: float
    z: float

    @property
    def found(self) -> bool:
        """Whether the load coasts."""
        return self.kappa > LEAST_KAPPA and self.z > LEAST_Z


def coasting(problem: Problem, fit: Fit) -> Coasting:
    """The score test for a fit of this problem."""
    p, _ = problem.input(fit)
    b, a = problem.family.at(fit.xi)
    column = lfilter(b, a, fit.m * run_on(problem.v, p, fit.gap))
    known = problem.known
    y = problem.output(fit)
    others = problem.jacobian(fit, y)[known]
    others = others / np.maximum(np.abs(others).max(axis=0), 1e-300)
    q = np.linalg.qr(others)[0]
    s = column[known] - q @ (q.T @ column[known])
    r = (problem.y - y)[known]
    squares = float(s @ s)
    if squares <= 1e-12 * float(column @ column):
        return Coasting(0.0, 0.0)
    kappa = float(s @ r) / squares
    return Coasting(kappa, kappa * squares**0.5 / max(fit.noise, fit.rms))


def run_on(v: Array, p: Array, gap: float) -> Array:
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
