"""What was learned before the run, and samples that say little of it."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
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


class Gear:
    """G behind the gap, with readings that are off by `disturbed` besides the noise."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.p, self.u, self.y = 0.0, [0.0] * 2, [0.0] * 2

    def reading(self, v: float, disturbed: float = 0.0) -> float:
        self.p = clamp(self.p, v - 0.5, v + 0.5)
        self.u.append(self.p)
        self.y.append(
            NUMERATOR[0] * self.u[-1] + NUMERATOR[1] * self.u[-2]
            - DENOMINATOR[1] * self.y[-1] - DENOMINATOR[2] * self.y[-2]
        )
        return self.y[-1] + disturbed + 1e-4 * float(self.rng.standard_normal())


def learn(estimator: MovingHorizon, v: float, y: float) -> None:
    estimator.update(y, Interval(v, v, v, 0.0))
    estimator.refine()


def started(std: float) -> MovingHorizon:
    """With crossings that are known so well from before."""
    inherited = replace(INHERITED, std_m=0.01, std_c_r=std, std_c_l=std)
    estimator = build_controller(KNOWN, inherited).estimator
    assert isinstance(estimator, MovingHorizon)
    return estimator


def test_few_samples_after_a_rest_neither_replace_nor_widen_what_was_known() -> None:
    estimator, gear = started(0.02), Gear()
    for k in range(460):
        v = 3.0 * sin(2.0 * pi * min(k, 59) / 200.0)
        learn(estimator, v, gear.reading(v))
    before = estimator.estimate
    # What was stuck breaks away in its own way.
    for k in range(60):
        turned = v - 3.0 + 3.0 * cos(2.0 * pi * k / 60.0)
        learn(estimator, turned, gear.reading(turned, 0.2 * sin(0.2 * k)))
        now = estimator.estimate
        assert now.c_r - now.c_l == pytest.approx(before.c_r - before.c_l, abs=0.01)
        assert now.std_c_r + now.std_c_l < 0.025
    assert now.status is not Status.NOT_EXCITED
