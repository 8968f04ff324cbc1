"""What is known of theta = (m, m c_r, m c_l), what drift makes of it, and whether two agree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from backlash_ros.core.estimate import Estimate

Array = NDArray[np.float64]

CHANCE = 1e-3  # of a difference that is no chance
# --- guards
SHARPEST = 1e-9  # relative deviation of an estimate that is taken for exact


class Prior(NamedTuple):
    """What is known of theta = (m, m c_r, m c_l) from elsewhere: mean (3,), covariance (3, 3)."""

    theta: Array
    cov: Array


def prior_of(estimate: Estimate, cov: Array | None = None) -> Prior:
    """What an estimate with its deviations says.

    cov: covariance (3, 3) of m, c_r, c_l, where more is known of them than their deviations.
    """
    m, c_r, c_l = estimate.m, estimate.c_r, estimate.c_l
    std = np.array([estimate.std_m, estimate.std_c_r, estimate.std_c_l])
    std = np.maximum(std, SHARPEST * np.array([m, c_r - c_l, c_r - c_l]))
    theta = np.array([m, m * c_r, m * c_l])
    return Prior(theta, _cov_of_theta(m, c_r, c_l, np.diag(std**2) if cov is None else cov))


def drifted(theta: Array, cov: Array, drift: Array, samples: int) -> Prior:
    """What is left of theta (3,) and its covariance (3, 3) after so many samples of drift.

    drift: random walk of m, c_r, c_l per square root of a sample, shape (3,).
    """
    m, product_r, product_l = theta.tolist()
    added = np.diag(drift**2 * samples)
    return Prior(theta, cov + _cov_of_theta(m, product_r / m, product_l / m, added))


def _cov_of_theta(m: float, c_r: float, c_l: float, cov: Array) -> Array:
    """Covariance (3, 3) of theta for one (3, 3) of m, c_r, c_l."""
    jacobian = np.array([[1.0, 0.0, 0.0], [c_r, m, 0.0], [c_l, 0.0, m]])
    return np.asarray(jacobian @ cov @ jacobian.T)


def contradicts(one: Prior, other: Prior) -> bool:
    """Whether two independent estimates of theta differ by more than chance."""
    return beyond_chance(one.theta - other.theta, one.cov + other.cov)


def beyond_chance(difference: Array, cov: Array) -> bool:
    """Whether a difference (n,) of this covariance (n, n) is one in 1,000 or rarer."""
    squares = float(difference @ np.linalg.solve(cov, difference))
    return squares > float(chdtri(len(difference), CHANCE))
