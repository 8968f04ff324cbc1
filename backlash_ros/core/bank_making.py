"""The banks of a search: what they believe before the first sample, and which noise they expect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.crossings import Crossings
from backlash_ros.core.estimation.protocol import Bounds, Estimate
from backlash_ros.core.gap_bank import GapBank, Noise, Prior, Start
from backlash_ros.core.record_search import RecordOptimum
from backlash_ros.core.state_model import StateModel

Array = NDArray[np.float64]

COARSE_TOLERANCE = 0.1  # half of the relative distance between the gaps of the coarse bank
FINE_TOLERANCE = 1e-6  # keeps the comparison finite when the estimate is exact
# Without noise the filter still needs some, this far below what one sample of u does to x.
NOISE_FLOOR = 1e-6
SLOPE_REACH = 30.0  # standard deviation of the slope before the first sample, in first guesses


@dataclass(frozen=True)
class SearchSettings:
    """What a search needs to know: the model, the bounds, the first guess and the noise."""

    model: StateModel
    bounds: Bounds
    initial: Estimate
    noise_std: float  # of y
    input_noise_std: float  # of u
    drift_std: tuple[float, float, float]  # of m, c_r, c_l per square root of a sample
    sample_period: float


class BankMaker:
    """Makes all banks of a search alike."""

    def __init__(self, settings: SearchSettings) -> None:
        self.settings = settings
        self.noise_floor = 0.0

    def see_motion(self, largest_v: float) -> None:
        """Take the scale of things from the first motion of v."""
        s = self.settings
        motion = largest_v * s.initial.m
        self.noise_floor = NOISE_FLOOR * float(np.linalg.norm(s.model.b)) * motion

    def coarse(self, gaps: Array) -> GapBank:
        """A bank over all gaps, with the hypothesis that v never engaged."""
        s = self.settings
        return GapBank(
            gaps, s.model, self._prior(s.initial), self.noise(s.initial), COARSE_TOLERANCE,
            with_null=True,
        )

    def fine(self, gaps: Array, at: Crossings, inherited: Crossings | None) -> GapBank:
        """A bank around an estimate; inherited: what was learned before and is still believed."""
        s = self.settings
        if inherited is None:
            prior = self._prior(s.initial)
        else:
            deviations = inherited.std_m, inherited.std_c_r, inherited.std_c_l
            prior = self._prior(inherited, covariance_of_products(inherited, deviations))
        return GapBank(gaps, s.model, prior, self.noise(at), FINE_TOLERANCE)

    def fitted(self, best: RecordOptimum, y: Array, v: Array) -> GapBank:
        """A bank for the gaps and reaches of a fit, and the record (y, v) it is going to read."""
        s = self.settings
        prior = Prior(
            best.m * np.array([1.0, s.initial.c_r, s.initial.c_l]), self._slope_std(s.initial)
        )
        start = Start(best.reaches, float(np.nanmax(y) - np.nanmin(y)), float(np.abs(v).max()))
        return GapBank(
            best.gaps, s.model, prior, self.noise(s.initial), FINE_TOLERANCE, start=start
        )

    def noise(self, at: Estimate | Crossings) -> Noise:
        """What is expected of a bank near an estimate, on which the drift of theta depends."""
        s = self.settings
        return Noise(
            max(s.noise_std, self.noise_floor), s.input_noise_std,
            covariance_of_products(at, s.drift_std) if any(s.drift_std) else None,
        )

    def _prior(self, at: Estimate | Crossings, inherited: Array | None = None) -> Prior:
        theta = np.array([at.m, at.m * at.c_r, at.m * at.c_l])
        return Prior(theta, self._slope_std(at), inherited)

    def _slope_std(self, at: Estimate | Crossings) -> float:
        return min(SLOPE_REACH * at.m, self.settings.bounds.m[1])


def covariance_of_products(at: Estimate | Crossings, std: tuple[float, float, float]) -> Array:
    """Covariance (3, 3) of theta that follows from deviations of m, c_r, c_l, independent."""
    jacobian = np.array([[1.0, 0.0, 0.0], [at.c_r, at.m, 0.0], [at.c_l, 0.0, at.m]])
    return np.asarray(jacobian @ np.diag(np.square(std)) @ jacobian.T)
