"""What every linear part of the controller offers: it turns y_m into u_d and v."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from backlash_ros.core.estimator import Estimate
from backlash_ros.core.inverse import BacklashInverse


@dataclass(frozen=True)
class Command:
    """Desired input u_d of G, the control v that shall cause it, and the gain f in use."""

    u_d: float
    v: float
    f: float


class Structure(Protocol):
    """Makes u_d from the reference and drives the inverse with it."""

    def control(self, y_m: float, estimate: Estimate, inverse: BacklashInverse) -> Command:
        """Return the command of this sample; advances the inverse by one step."""
