"""How much of x_hat - x* may be noise: of y, of x_hat, and of the references that make x*."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.tracking.design import TrackingDesign
from backlash_ros.core.control.tracking.rest import ARRIVED, CLOSE, UNCERTAIN

Array = NDArray[np.float64]


class DeviationNoise:
    """Standard deviations of x_hat - x*, and of what the gains of a design make of it.

    known: whether that of x_hat is. x_std: of |x_hat|. u_std: of K (x_hat - x*) for every gain of
    the schedule, and at least K times errors of y of half its noise y_std, as configured. ignored:
    |x_hat - x*| that is left alone. tolerated: that is worth no crossing.
    """

    def __init__(self, design: TrackingDesign, y_std: float) -> None:
        self._design = design
        self.known = False
        self.x_std = self.ignored = self.tolerated = 0.0
        self.x_cov: Array | None = None
        self._x_noise: Array | None = None
        # Variances of K x for every gain and of |x|: of x_hat, and of x* for noise of 1.
        none: Array = np.zeros(len(design.schedule) + 1)
        self._of_x_hat = self._of_references = none
        self._least = 0.5 * y_std * np.array(design.schedule_sizes)
        self.u_std: list[float] = self._least.tolist()

    def take(
        self, x_cov: Array | None, y_std: float, x_noise: Array | None = None,
        reference_std: float = 0.0,
    ) -> None:
        """Take in covariances and noise of this sample.

        x_cov: of x_hat, None where it is unknown. y_std: of the noise of y, as measured where that
        is more. x_noise: of x* for noise of 1 in the references. reference_std: of theirs.
        """
        if x_cov is not None and x_cov is not self.x_cov:
            self._of_x_hat = self._design.variances(x_cov)
        if x_noise is not None and x_noise is not self._x_noise:
            self._of_references = self._design.variances(x_noise)
        self.x_cov, self._x_noise, self.known = x_cov, x_noise, x_cov is not None
        deviation_std = 0.0
        if self.known:
            self.x_std = max(self._of_x_hat.item(-1), 0.0)**0.5
            variances = self._of_x_hat + reference_std**2 * self._of_references
            stds = np.sqrt(np.maximum(variances, 0.0))
            self.u_std, deviation_std = np.maximum(stds[:-1], self._least).tolist(), stds.item(-1)
        # By as much v may rest off: one rule for motion and rest.
        self.ignored = ARRIVED * max(CLOSE * y_std, UNCERTAIN * self.x_std)
        # What noise of the references moves and v did not follow shows as a deviation as well.
        self.tolerated = max(self.ignored, ARRIVED * UNCERTAIN * deviation_std)
