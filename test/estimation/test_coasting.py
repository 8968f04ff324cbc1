"""A load that runs on within the gap is told from a gap, and from a lag, that were not known."""

from __future__ import annotations

from math import pi, sin

import pytest

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimation.moving_horizon.moving_horizon import MovingHorizon
from backlash_ros.core.estimation.protocol import Estimate, Interval, Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import clamp

# Second order, 20 Hz, at 200 Hz, as in geared_motor.yaml.
NUMERATOR, DENOMINATOR = (0.15678154, 0.12688103), (1.0, -1.24982552, 0.53348809)
KNOWN = Parameters({
    'sample_period': 0.005, 'plant.numerator': NUMERATOR, 'plant.denominator': DENOMINATOR,
    'plant.uncertainty': 0.05, 'estimator.output_noise_std': 1e-4,
    'estimator.initial.m': 1.0, 'estimator.initial.c_r': 0.5, 'estimator.initial.c_l': -0.5,
})
INHERITED = Estimate(1.0, 0.5, -0.5, 0.0, 1e-3, 2e-3, 2e-3)
AMPLITUDE, FREQUENCY = 3.0, 2.0 * pi / 200.0  # of v, in gaps, and per sample
ACCELERATION = AMPLITUDE * FREQUENCY**2


def run(deceleration: float, late: int = 0, samples: int = 300) -> MovingHorizon:
    """Move v as a sine. deceleration: of a load in the gap, by friction. late: samples of delay."""
    estimator = build_controller(KNOWN, INHERITED).estimator
    assert isinstance(estimator, MovingHorizon)
    p, speed = 0.5, 0.0
    u = [0.0] * (2 + late)
    y = [0.0, 0.0]
    for k in range(samples):
        v = AMPLITUDE * sin(FREQUENCY * k)
        on = max(abs(speed) - deceleration, 0.0)
        moved = clamp(p + (on if speed > 0.0 else -on), v, v + 1.0)
        p, speed = moved, moved - p
        u.append(p - 0.5)
        y.append(
            NUMERATOR[0] * u[-1 - late] + NUMERATOR[1] * u[-2 - late]
            - DENOMINATOR[1] * y[-1] - DENOMINATOR[2] * y[-2]
        )
        estimator.update(y[-1], Interval(v, v, v, 0.0))
        estimator.refine()
    return estimator


def test_a_load_that_coasts_is_named_and_its_crossings_are_in_doubt() -> None:
    estimator = run(0.5 * ACCELERATION)
    assert estimator.estimate.status is Status.INCONSISTENT
    assert estimator.coasts
    assert estimator.estimate.c_r == pytest.approx(0.5, abs=0.01)
    assert estimator.estimate.std_c_r > 0.1


def test_friction_that_stops_the_load_is_backlash() -> None:
    estimator = run(2.0 * ACCELERATION)
    assert not estimator.coasts
    assert estimator.estimate.status is not Status.INCONSISTENT
    assert estimator.estimate.std_c_r < 0.01


def test_a_lag_that_nobody_told_of_is_no_load_that_coasts() -> None:
    estimator = run(2.0 * ACCELERATION, late=8)
    assert not estimator.coasts
