"""Figures of merit, on runs whose figures are known."""

from math import exp, nan

import numpy as np
import pytest

from backlash_ros.core.simulation.metrics import control_error_rms, settling_time
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord

T = np.arange(1000) * 0.01
ONES = np.ones(1000)


def run(samples: int = 1000, **signals: object) -> RunRecord:
    rows = np.full((samples, len(COLUMNS)), nan)
    rows[:, COLUMNS.index('t')] = T[:samples]
    for name, values in signals.items():
        rows[:, COLUMNS.index(name)] = values
    return RunRecord(rows, 0.01)


def test_settling_time_of_an_exponential_is_when_it_reaches_one_percent() -> None:
    estimate = 3.0 * (1.0 + np.exp(-T))
    assert exp(-4.61) < 0.01 < exp(-4.60)
    assert settling_time(T, estimate, 3.0 * ONES) == pytest.approx(4.61)
    assert settling_time(T, -estimate, -3.0 * ONES) == pytest.approx(4.61)


def test_run_without_samples_has_no_figures() -> None:
    nothing = run(samples=0)
    assert nothing.samples == 0
    assert not nothing.has_truth
    assert control_error_rms(nothing) is None
    assert settling_time(T[:0], ONES[:0], ONES[:0]) is None


def test_truth_is_known_only_if_it_is_known_throughout() -> None:
    assert run(true_m=1.3).has_truth
    assert not run().has_truth
    assert not run(true_m=np.where(T < 1.0, nan, 1.3)).has_truth
