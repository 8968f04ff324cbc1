"""From the products theta = (m, m c_r, m c_l), which enter linearly, to m, c_r, c_l."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Crossings:
    """m, c_r, c_l with their standard deviations, and that of the gap c_r - c_l."""

    m: float
    c_r: float
    c_l: float
    std_m: float
    std_c_r: float
    std_c_l: float
    std_gap: float

    @property
    def gap(self) -> float:
        """Width of the gap, c_r - c_l."""
        return self.c_r - self.c_l


def crossings_of(theta: NDArray[np.float64], cov: NDArray[np.float64]) -> Crossings | None:
    """Divide theta (3,) by m and carry its covariance (3, 3) along to first order.

    None unless m > 0. Written in floats: it runs at every sample.
    """
    m, product_r, product_l = theta.tolist()
    if not m > 0.0:
        return None
    (p_mm, p_mr, p_ml), (_, p_rr, p_rl), (_, _, p_ll) = cov.tolist()
    c_r, c_l = product_r / m, product_l / m
    # d c = (d product - c d m) / m
    var_r = (p_rr - 2.0 * c_r * p_mr + c_r * c_r * p_mm) / (m * m)
    var_l = (p_ll - 2.0 * c_l * p_ml + c_l * c_l * p_mm) / (m * m)
    cov_rl = (p_rl - c_l * p_mr - c_r * p_ml + c_r * c_l * p_mm) / (m * m)
    var_gap = var_r + var_l - 2.0 * cov_rl
    return Crossings(
        m, c_r, c_l, sqrt(max(p_mm, 0.0)), sqrt(max(var_r, 0.0)), sqrt(max(var_l, 0.0)),
        sqrt(max(var_gap, 0.0)),
    )
