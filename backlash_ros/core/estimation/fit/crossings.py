"""From the products theta = (m, m c_r, m c_l), which enter linearly, to m, c_r, c_l."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate


@dataclass(frozen=True)
class Crossings:
    """m, c_r, c_l with their standard deviations, and that of the gap c_r - c_l.

    cov: their covariance, shape (3, 3).
    """

    m: float
    c_r: float
    c_l: float
    std_m: float
    std_c_r: float
    std_c_l: float
    std_gap: float
    cov: NDArray[np.float64]

    @property
    def gap(self) -> float:
        """Width of the gap, c_r - c_l."""
        return self.c_r - self.c_l


def crossings_of(theta: NDArray[np.float64], cov: NDArray[np.float64]) -> Crossings | None:
    """Divide theta (3,) by m and carry its covariance (3, 3) along to first order.

    None unless m > 0.
    """
    m, product_r, product_l = theta.tolist()
    if not m > 0.0:
        return None
    c_r, c_l = product_r / m, product_l / m
    # d c = (d product - c d m) / m
    jacobian = np.array([[1.0, 0.0, 0.0], [-c_r / m, 1.0 / m, 0.0], [-c_l / m, 0.0, 1.0 / m]])
    of_all = jacobian @ cov @ jacobian.T
    (var_m, *_), (_, var_r, cov_rl), (_, _, var_l) = of_all.tolist()
    return Crossings(
        m, c_r, c_l, sqrt(max(var_m, 0.0)), sqrt(max(var_r, 0.0)), sqrt(max(var_l, 0.0)),
        sqrt(max(var_r + var_l - 2.0 * cov_rl, 0.0)), of_all,
    )


def difference(found: Crossings, estimate: Estimate) -> NDArray[np.float64]:
    """By how much (m, c_r, c_l) differ from those of an estimate, shape (3,)."""
    return np.array([found.m - estimate.m, found.c_r - estimate.c_r, found.c_l - estimate.c_l])
