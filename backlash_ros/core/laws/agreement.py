"""Whether estimates agree with what was measured lately, for laws that have no deviations.

u, or what is made of it linearly, is t = theta' phi for the true theta = (m, m c_r, m c_l). With
R = E{phi phi'} over many samples, and phi scaled to E{phi_i^2} = 1, the estimates may be wrong by

    |theta - theta_hat|^2 <= E{(t - theta_hat' phi)^2} / (smallest eigenvalue of R)
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate, Status

# Square of a signal below which it counts as none. Its inverse, times the square of any
# measurement, still is a number.
LEAST_SQUARE = 1e-240
MEMORY = 200  # samples over which means are taken, with weights that fade
LEAST_SAMPLES, EVERY = 100, 20  # before the first judgement, and from one to the next


class Agreement:
    """Means of the products of phi and t, by which estimates are judged.

    status: TRACKING while no theta that explains the samples differs from the estimate that was
    judged last, nor this one from the newest, by more than a tenth of what the crossings make of t;
    INCONSISTENT where the samples ask for a negative slope; ACQUIRING otherwise.
    """

    def __init__(self) -> None:
        self.status = Status.ACQUIRING
        self._samples = 0
        self._rows: list[Sequence[float]] = []  # (phi, t) since the means were taken
        self._products = np.zeros((4, 4))  # means of (phi, t)(phi, t)'
        # Products judged last, the weights of their errors, and the largest sum of squares.
        self._judged, self._weights, self._most = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0

    def judged(self, new: Estimate, row: Sequence[float]) -> Estimate:
        """The estimate with its status, after the three elements of phi, and t, of this sample."""
        theta = new.m, new.m * new.c_r, new.m * new.c_l
        self._rows.append(row)
        if len(self._rows) == EVERY:
            self._samples += EVERY
            rows, self._rows = np.array(self._rows), []
            share = EVERY / min(self._samples, MEMORY)
            self._products += share * (rows.T @ rows / EVERY - self._products)
            if self._samples >= LEAST_SAMPLES:
                self.status = self._judge(theta)
        elif self.status is Status.TRACKING:
            moved = zip(theta, self._judged, self._weights, strict=True)
            if sum((weight * (now - then)) ** 2 for now, then, weight in moved) > self._most:
                self.status = Status.ACQUIRING
        return replace(new, status=self.status)

    def _judge(self, theta: tuple[float, float, float]) -> Status:
        size = np.sqrt(np.diag(self._products)[:3])
        if float(size.min()) ** 2 <= LEAST_SQUARE:
            return Status.ACQUIRING
        eigenvalues, vectors = np.linalg.eigh(self._products[:3, :3] / np.outer(size, size))
        least = float(eigenvalues[0])
        # No more than the rounding of the sums: the samples do not tell one theta from all others.
        if least <= 1e-12 * float(eigenvalues[-1]):
            return Status.ACQUIRING
        most = 0.1**2 * float((theta[1] * size[1]) ** 2 + (theta[2] * size[2]) ** 2)
        if self._mean_square(np.array(theta)) <= least * most:
            self._judged, self._most, self._weights = theta, most, tuple(size.tolist())
            return Status.TRACKING
        # With R = Q diag(l) Q' this is R^-1, positive definite whatever rounding does to R.
        inverse = (vectors / eigenvalues) @ vectors.T
        best = inverse @ (self._products[:3, 3] / size) / size
        variance = self._mean_square(best) * float(inverse[0, 0])
        deviation = sqrt(variance / min(self._samples, MEMORY)) / float(size[0])
        return Status.INCONSISTENT if float(best[0]) < -5.0 * deviation else Status.ACQUIRING

    def _mean_square(self, theta: NDArray[np.float64]) -> float:
        """Mean of (t - theta' phi)^2."""
        weights = np.append(-theta, 1.0)
        return max(float(weights @ self._products @ weights), 0.0)
