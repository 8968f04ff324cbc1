"""The signals of one run, simulated or recorded, a row per sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COLUMNS = (
    't', 'y_m', 'y', 'u_d', 'v', 'u', 'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l',
    'u_hat', 'innovation', 'status', 'true_m', 'true_c_r', 'true_c_l',
)
_INDEX = {name: i for i, name in enumerate(COLUMNS)}


@dataclass(frozen=True)
class RunRecord:
    """rows: shape (N, len(COLUMNS)), one per sample that reached the controller.

    t [s] counts sample periods from the first one. u and true_* are nan without a simulation.
    Estimates stand as they were when v was computed. lost_samples: outputs that never arrived.
    """

    rows: NDArray[np.float64]
    sample_period: float
    lost_samples: int = 0

    def column(self, name: str) -> NDArray[np.float64]:
        """One signal by name, shape (N,)."""
        return self.rows[:, _INDEX[name]]

    @property
    def samples(self) -> int:
        """Number of rows N."""
        return len(self.rows)

    @property
    def has_truth(self) -> bool:
        """Whether the true u and backlash are known."""
        return bool(np.isfinite(self.column('true_m')).all()) and self.samples > 0
