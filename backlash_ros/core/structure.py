"""What every linear part of the controller offers: it turns y_m into u_d and v."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimator import Estimate
from backlash_ros.core.inverse import BacklashInverse


class Situation(NamedTuple):
    """What is known at a sample: reference, output, estimate and state of G with its covariance.

    x_hat (n,) and x_cov (n, n) are in the coordinates of StateModel; x_cov is None where the
    estimator has none.
    """

    y_m: float
    y: float
    estimate: Estimate
    x_hat: NDArray[np.float64]
    x_cov: NDArray[np.float64] | None = None


class Command(NamedTuple):
    """Desired input u_d of G, the control v that shall cause it, and the gain f in use."""

    u_d: float
    v: float
    f: float


class Structure(Protocol):
    """Makes u_d from the reference and drives the inverse with it."""

    @property
    def delay(self) -> int:
        """Samples by which y is meant to follow y_m."""

    def control(self, situation: Situation, inverse: BacklashInverse) -> Command:
        """Return the command of this sample; advances the inverse by one step."""
