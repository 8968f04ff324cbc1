"""What a fit is made around, and what it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit.crossings import Crossings
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.regression.error_model import ErrorModel
from backlash_ros.core.estimation.regression.posterior import Posterior
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

# --- guards
SMALLEST_NOISE = 1e-12  # deviation of y that is assumed at least


class Around(NamedTuple):
    """What a fit is made around.

    error: G and its error model. told_std: noise on y as told. prior: of theta. most: largest
    scale of the error that is believed. walk: deviation by which a disturbance of u walks over the
    record [unit of u], 0 for none. inherited: whether the backlash was known before the first
    sample: then what contradicts it needs more to be believed than where samples of this run alone
    have told it.
    """

    error: ErrorModel
    told_std: float
    prior: Prior | None = None
    most: float = inf
    walk: float = 0.0
    inherited: bool = False

    @property
    def model(self) -> StateModel:
        """G."""
        return self.error.model


@dataclass(frozen=True)
class Solution:
    """What the samples of a window say.

    posterior: of all unknowns. crossings: with honest deviations; None unless m > 0. gap: of the
    solution, start: p of the solution at the start. count: samples that count, repeated readings
    once. correlation: of the residual with itself, beyond chance. inflation: 1 - rho + N rho, by
    which the covariance is widened; beside a prior, that of the samples alone. rms: of the
    residual. alone: of the samples without their prior, None where that was not asked for. leaky:
    gives the posterior where an integrator of G leaks for sure.
    """

    posterior: Posterior
    theta: Array
    theta_cov: Array
    crossings: Crossings | None
    gap: float
    start: float
    count: float
    correlation: float
    inflation: float
    rms: float
    alone: Solution | None
    leaky: Callable[[], Posterior]

    @property
    def m(self) -> float:
        """Slope; negative where v and y have opposite signs."""
        return float(self.theta[0])

    @property
    def of_theta(self) -> Prior:
        """What it says of theta."""
        return Prior(self.theta, self.theta_cov)

    @property
    def moved_otherwise(self) -> bool:
        """Whether y moves in a way that no backlash and no G explains, beyond chance."""
        return self.count * self.correlation > 1.0

    @property
    def std_gap(self) -> float:
        """Standard deviation of the gap; inf unless m > 0."""
        return self.crossings.std_gap if self.crossings is not None else inf
