"""What the laws share that learn from u reconstructed some samples late."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.baselines.history import History
from backlash_ros.core.estimation.baselines.input_reconstruction import InputReconstruction


class LaggedLaw:
    """Reconstruction of u, and what was applied when it acted."""

    def __init__(self, reconstruction: InputReconstruction) -> None:
        self.adapting = True
        self._reconstruction = reconstruction
        self._history = History(reconstruction.lag)

    @property
    def u_hat(self) -> float:
        """Reconstruction of u, `lag` samples old."""
        return self._reconstruction.u_hat

    @property
    def x_hat(self) -> NDArray[np.float64]:
        """State of G in the coordinates of StateModel, shape (n,)."""
        return self._reconstruction.x_hat

    @property
    def x_cov(self) -> None:
        """No covariance."""
        return None

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction; nan where y(k) was lost."""
        return self._reconstruction.innovation

    def refine(self, budget_s: float = inf) -> None:
        """Nothing is left to do after the command."""
