"""The signals of one run, simulated or recorded, a row per sample."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimates_file import was_given
from backlash_ros.core.law import Law
from backlash_ros.core.loop.learned_model import LearnedModel

COLUMNS = (
    't', 'y_m', 'y', 'u_d', 'v', 'u', 'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l',
    'u_hat', 'innovation', 'status', 'true_m', 'true_c_r', 'true_c_l',
)
_INDEX = {name: i for i, name in enumerate(COLUMNS)}


def stated_deviations(e: Estimate) -> tuple[float, float, float]:
    """Standard deviations of m, c_r, c_l as they are published and recorded.

    Those of constants that are taken as given are nan: nobody has learned how wrong they are.
    """
    return (nan, nan, nan) if was_given(e) else (e.std_m, e.std_c_r, e.std_c_l)


def row_of(
    t: float, y: float, v: float, u: float, step: ControlStep, law: Law,
    truth: tuple[float, float, float] = (nan, nan, nan),
) -> tuple[float, ...]:
    """The row of a sample; v: that was sent, u and truth: nan where nobody knows them."""
    e = step.estimate
    return (
        t, step.y_m, y, step.u_d, v, u, e.m, e.c_r, e.c_l, e.f, *stated_deviations(e), law.u_hat,
        law.innovation, e.status, *truth,
    )


@dataclass(frozen=True)
class RunRecord:
    """rows: shape (N, len(COLUMNS)), one per sample that reached the controller.

    t [s] counts sample periods from the first one. u and true_* are nan without a simulation.
    Estimates stand as they were when v was computed. lost_samples: outputs that never arrived.
    learned: what the controller believed of G at the end, None where it is not known.
    """

    rows: NDArray[np.float64]
    sample_period: float
    lost_samples: int = 0
    learned: LearnedModel | None = None

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
