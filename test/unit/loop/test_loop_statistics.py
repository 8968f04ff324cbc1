"""One definition of latency: what /diagnostics says is what a report says of the same samples."""

import numpy as np

from backlash_ros.core.loop.loop_statistics import Lately, LoopStatistics


def test_what_was_gained_lately_is_never_negative_after_a_new_beginning() -> None:
    lately = Lately()
    for t in range(10):
        gained = lately.gained({'used': 100 * t, 'lost': 0}, float(t))
    assert gained['used'] > 100
    assert lately.gained({'used': 40, 'lost': 3}, 10.0) == {'used': 40, 'lost': 3}
    assert lately.gained({'used': 90, 'lost': 3}, 11.0) == {'used': 50, 'lost': 0}


def noted(values: list[float], still_band: float = 0.0) -> LoopStatistics:
    statistics = LoopStatistics(still_band=still_band)
    for k, y in enumerate(values):
        statistics.note(y, float(k % 5), False, False, 0.0)
    return statistics


def test_a_y_that_moves_within_its_noise_stands_still() -> None:
    noise = (1e-3 * np.random.default_rng(1).normal(size=100)).tolist()
    assert noted(noise).still == 1
    assert noted(noise, 6e-3).still == 100
    assert noted(noise, 6e-3).still_swing == 4.0
    assert noted([*noise, 0.1], 6e-3).still == 1


def test_an_angle_that_wraps_is_told_from_one_that_moves_fast() -> None:
    turning = 0.05 * np.arange(400.0)
    assert noted(turning.tolist()).wraps == 0
    assert noted(((turning + np.pi) % (2.0 * np.pi) - np.pi).tolist()).wraps == 3
    assert noted((6.2832 * np.arange(50.0)).tolist()).wraps == 0
