"""What the laws share that learn from u reconstructed some samples late."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.agreement import Agreement
from backlash_ros.core.laws.input_reconstruction import InputReconstruction

STROKE = 8  # samples to either side over which u moves on in one direction


class LaggedLaw(Law):
    """Reconstruction of u, what was applied when it acted, and whether estimates agree with it."""

    def __init__(self, reconstruction: InputReconstruction) -> None:
        self._reconstruction = reconstruction
        self._applied: deque[Interval] = deque(maxlen=reconstruction.lag)
        self._threshold = 2.0 * reconstruction.std
        self._past: deque[float] = deque([0.0, 0.0], maxlen=STROKE + 1)
        self._agreement = Agreement()

    @property
    def u_hat(self) -> float:
        """Reconstruction of u, `lag` samples old."""
        return self._reconstruction.u_hat

    @property
    def x_hat(self) -> NDArray[np.float64]:
        """State of G in the coordinates of StateModel, shape (n,)."""
        return self._reconstruction.x_hat

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction; nan where y(k) was lost."""
        return self._reconstruction.innovation

    def _follow(self, y: float | None, interval: Interval) -> tuple[float, Interval | None]:
        """Take in y(k), None if it was lost, and what was applied before it.

        Returns the u that the reconstruction has reached, and what was applied with it; None while
        nothing is to be learned from that.
        """
        u = self._reconstruction.update(y)
        self._past.append(u)
        self._applied.append(interval)  # the newest carried u(k-1), the oldest u(k-lag)
        learns = self.adapting and self._reconstruction.ready
        return u, self._applied[0] if learns else None

    def _rising(self, u: float) -> bool | None:
        """Whether u moves on the right line (True) or the left one; None where it may rest.

        u rises only on the right line and falls only on the left one, so that no wrong side can
        lock in. It counts as moving on by two deviations of its error, as smoothing rounds the
        corners, and at no less than a quarter of the mean pace of the stroke.
        """
        ahead = self._reconstruction.newer(STROKE) - u
        behind = u - self._past[0]
        step, rising = u - self._past[-2], True
        if min(ahead, behind, step) < 0.0:
            ahead, behind, step = -ahead, -behind, -step
            rising = False
        slowest = min(ahead, behind)
        if slowest <= self._threshold or step < 0.25 * slowest / STROKE:
            return None
        return rising

    def _take(self, new: Estimate, u: float, v: float, rising: bool) -> None:
        """Go on with this estimate, as far as this sample and those before it agree with it."""
        row = (v, -1.0, 0.0, u) if rising else (v, 0.0, -1.0, u)
        self.estimate = self._agreement.judged(new, row)
