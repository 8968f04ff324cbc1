"""A load that runs on within the gap is told from a gap, and from a lag, that were not known."""

from math import pi, sin

import pytest
from known_gear import KNOWN, answers, estimator_knowing, learn

from backlash_ros.core.estimate import Status
from backlash_ros.core.law import Law
from backlash_ros.core.plant.backlash import clamp

AMPLITUDE, FREQUENCY = 3.0, 2.0 * pi / 200.0  # of v, in gaps, and per sample
ACCELERATION = AMPLITUDE * FREQUENCY**2


def run(deceleration: float, late: int = 0, samples: int = 300) -> Law:
    """Move v as a sine. deceleration: of a load in the gap, by friction. late: samples of delay."""
    v = [AMPLITUDE * sin(FREQUENCY * k) for k in range(samples)]
    u, p, speed = [], 0.5, 0.0
    for wall in v:
        on = max(abs(speed) - deceleration, 0.0)
        moved = clamp(p + (on if speed > 0.0 else -on), wall, wall + 1.0)
        p, speed = moved, moved - p
        u.append(p - 0.5)
    estimator = estimator_knowing(KNOWN)
    for applied, y in zip(v, answers(u, late).tolist(), strict=True):
        learn(estimator, applied, y)
    return estimator


def test_a_load_that_coasts_is_named_and_its_crossings_are_in_doubt() -> None:
    estimator = run(0.5 * ACCELERATION)
    assert estimator.estimate.status is Status.INCONSISTENT
    assert estimator.report.coasts
    assert estimator.estimate.c_r == pytest.approx(0.5, abs=0.01)
    assert estimator.estimate.std_c_r > 0.1


def test_friction_that_stops_the_load_is_backlash() -> None:
    estimator = run(2.0 * ACCELERATION)
    assert not estimator.report.coasts
    assert estimator.estimate.status is not Status.INCONSISTENT
    assert estimator.estimate.std_c_r < 0.01


def test_a_lag_that_nobody_told_of_is_no_load_that_coasts() -> None:
    estimator = run(2.0 * ACCELERATION, late=8)
    assert not estimator.report.coasts
