"""A reading has a density, and slope and information are those of its logarithm."""

import numpy as np
import pytest

from backlash_ros.core.estimation.posterior import independence, likelihood, mean_information

APART = 1e-3
R = APART * np.arange(-12_000, 12_001)


@pytest.mark.parametrize(('noise', 'step'), [(0.3, 0.0), (0.3, 1.0), (1.0, 1.0)])
def test_density_slope_and_information_belong_together(noise: float, step: float) -> None:
    found = likelihood(R, noise, step)
    density = np.exp(found.log_density)
    assert density.sum() * APART == pytest.approx(1.0, rel=1e-6)
    near = np.abs(R) < 4.0 * noise
    by_output = -np.gradient(found.log_density, R)
    assert found.score[near] == pytest.approx(by_output[near], abs=1e-3)
    expected = mean_information(step / noise) / step**2 if step else noise**-2
    assert (found.score**2 * density).sum() * APART == pytest.approx(expected, rel=1e-3)


def test_readings_that_repeat_one_rounding_count_as_one() -> None:
    y, known = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 9.0]), np.arange(6) < 5
    weights, begins = independence(y, known, np.full(6, 1.2), 1.0)
    assert weights == pytest.approx([1 / 3] * 3 + [0.5] * 2 + [0.0])
    assert begins.tolist() == [0, 3]
    assert independence(y, known, 0.1 * np.arange(6), 1.0)[0].tolist() == known.tolist()
