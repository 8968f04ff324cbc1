"""What was learned before the run, and samples that say little of it."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from known_gear import KNOWN, answers, estimator_knowing, learn

from backlash_ros.core.estimate import Status
from backlash_ros.core.plant.backlash import play_outputs

MOVES, RESTS, TURNS = 60, 400, 60  # samples


def test_few_samples_after_a_rest_neither_replace_nor_widen_what_was_known() -> None:
    estimator = estimator_knowing(replace(KNOWN, std_m=0.01, std_c_r=0.02, std_c_l=0.02))
    v = [3.0 * sin(2.0 * pi * min(k, MOVES - 1) / 200.0) for k in range(MOVES + RESTS)]
    v += [v[-1] - 3.0 + 3.0 * cos(2.0 * pi * k / 60.0) for k in range(TURNS)]
    y = answers([p - 0.5 for p in play_outputs(v, 1.0, 0.5)])
    y += 1e-4 * np.random.default_rng(5).standard_normal(len(y))
    # What was stuck breaks away in its own way.
    y[-TURNS:] += 0.2 * np.sin(0.2 * np.arange(TURNS))
    for k, (applied, reading) in enumerate(zip(v, y.tolist(), strict=True)):
        if k == MOVES + RESTS:
            before = estimator.estimate
        learn(estimator, applied, reading)
        if k >= MOVES + RESTS:
            now = estimator.estimate
            assert now.c_r - now.c_l == pytest.approx(before.c_r - before.c_l, abs=0.01)
            assert now.std_c_r + now.std_c_l <= 0.04 + 1e-9  # as was known
    assert now.status is not Status.NOT_EXCITED
