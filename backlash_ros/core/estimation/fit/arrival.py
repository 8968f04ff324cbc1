"""What samples that were let go still say of theta, beside what is known from elsewhere.

The error that a model makes of the plant is the same in one part of the record as in the next: two
parts are no independent witnesses, and what they say must not be counted twice. Covariance
intersection holds whatever their correlation is (S. J. Julier, J. K. Uhlmann, A non-divergent
estimation algorithm in the presence of unknown correlations, American Control Conference 1997,
2369-2373). So what a part of the record does not tell stays as well known as it was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import Fitted

Array = NDArray[np.float64]

# --- guards
ROUNDING = 1e-14  # share of the largest eigenvalue of a covariance that is rounding


def arrival(part: Fitted, contested: bool) -> Prior | None:
    """What is known of theta after a part of the record that is let go; None for nothing.

    contested: whether the whole record contradicts what was known before it.
    """
    around, solution = part.around, part.solution
    if not solution.m > 0.0:
        return around.prior
    if around.prior is None or not around.inherited:
        return solution.of_theta
    if solution.alone is None:
        return around.prior  # so few samples say nothing alone
    alone = solution.alone.of_theta
    return intersected(*(_doubted(around.prior, alone) if contested else (around.prior, alone)))


def _doubted(one: Prior, other: Prior) -> tuple[Prior, Prior]:
    """Two that contradict each other, with deviations wide enough for what lies between them.

    Both covariances times chi^2 per degree of freedom (R. T. Birge, The calculation of errors by
    the method of least squares, Physical Review 40 (1932) 207-227).
    """
    apart = one.theta - other.theta
    ratio = float(apart @ np.linalg.solve(one.cov + other.cov, apart)) / len(apart)
    ratio = max(ratio, 1.0)
    return one._replace(cov=ratio * one.cov), other._replace(cov=ratio * other.cov)


def intersected(one: Prior, other: Prior) -> Prior:
    """What two estimates of theta say together, however correlated they are.

    The mixture of their informations with the least volume of the deviations. The other one may
    leave directions unknown; LinAlgError where the first one does.
    """
    root = np.linalg.cholesky(one.cov)
    whitened = np.linalg.inv(root)
    var, axes = np.linalg.eigh(whitened @ other.cov @ whitened.T)
    # Beside a direction that is not known at all, what is known of others is lost in rounding.
    var = np.maximum(var, ROUNDING * var[-1])

    def information(share: float) -> Array:
        return np.asarray(share + (1.0 - share) / var)

    def volume(share: float) -> float:
        return -float(np.log(information(share)).sum())

    share = float(minimize_scalar(volume, bounds=(0.0, 1.0), method='bounded').x)
    back, there = root @ axes, axes.T @ whitened
    both = information(share)
    mean = (share * (there @ one.theta) + (1.0 - share) / var * (there @ other.theta)) / both
    return Prior(back @ mean, (back / both) @ back.T)
