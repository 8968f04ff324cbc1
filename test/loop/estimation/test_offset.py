"""A constant offset of u moves both crossings: they are learned, and v makes up for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from backlash_ros.core.estimate import Status
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.tools.config import effective_parameters

M, C_R, C_L = 0.098, 0.55, -0.35  # of geared_motor.yaml


@pytest.mark.parametrize('offset', [-0.1, -0.035, 0.06])
def test_crossings_on_one_side_of_zero_are_learned(offset: float) -> None:
    p = effective_parameters(Path('geared_motor.yaml'), [f'input_disturbance={offset}'])
    loop = build_closed_loop(p)
    run = loop.run(600)
    estimate = loop.controller.estimator.estimate
    assert estimate.status == Status.TRACKING
    assert estimate.m == pytest.approx(M, rel=1e-3)
    assert estimate.c_r == pytest.approx(C_R - offset / M, abs=2e-3)
    assert estimate.c_l == pytest.approx(C_L - offset / M, abs=2e-3)
    error = (run.column('u') + offset - run.column('u_d'))[-200:]
    assert np.sqrt(np.mean(error**2)) < 0.02 * M * (C_R - C_L)
