"""What many runs come to: bias, spread, settling and honesty of each estimated parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
from scipy.special import chdtri

from backlash_ros.core.simulation.metrics import SETTLING_TOLERANCE
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.tools.simulate.batch import Outcome
from backlash_ros.topics import BACKLASH


@dataclass(frozen=True)
class ParameterStatistics:
    """Statistics of one estimated parameter over runs.

    settling times [s]: inf for never. within: share of runs within 1 % at the end.
    nees: mean of (error / std)^2, nan without standard deviations; honest ones put it into
    nees_interval with 95 %.
    """

    bias: float
    rmse: float
    settling_median: float
    settling_max: float
    within: float
    nees: float
    nees_interval: tuple[float, float]


def statistics(outcomes: Sequence[Outcome]) -> dict[str, ParameterStatistics]:
    """Statistics of each estimated parameter over the runs that did not break off.

    Raises InputError where all of them did.
    """
    whole = [outcome for outcome in outcomes if not outcome.problem]
    if not whole:
        raise InputError(f'every run broke off, the first one with: {outcomes[0].problem}')
    return {name: _statistics(whole, i) for i, name in enumerate(BACKLASH)}


def _statistics(outcomes: Sequence[Outcome], i: int) -> ParameterStatistics:
    truth = np.array([outcome.truth[i] for outcome in outcomes])
    error = np.array([outcome.final[i] for outcome in outcomes]) - truth
    std = np.array([outcome.std[i] for outcome in outcomes])
    settling = np.array([outcome.settling[i] for outcome in outcomes])
    # The median of a number and "never" is never, not the nan of inf - inf.
    median = float(np.sort(settling)[len(settling) // 2])
    known = bool(np.all(np.isfinite(std) & (std > 0.0)))
    n = len(outcomes)
    # Quantiles of chi squared with n degrees of freedom: n times the mean has that distribution.
    low, high = chdtri(n, [0.975, 0.025]) / n
    return ParameterStatistics(
        float(error.mean()), float(np.sqrt(np.mean(error**2))), median, float(settling.max()),
        float(np.mean(np.abs(error) <= SETTLING_TOLERANCE * np.abs(truth))),
        float(np.mean((error / std) ** 2)) if known else nan, (float(low), float(high)),
    )
