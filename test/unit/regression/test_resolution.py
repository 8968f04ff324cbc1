"""What a reading of a sensor with a resolution tells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate
from scipy.stats import norm

from backlash_ros.core.estimation.regression.resolution import (
    cells,
    information_of,
    resolution_of,
)

STEP = 2.0 * np.pi / 2**14


def readings(step: float, count: int = 400, noise_std: float = 0.0) -> np.ndarray:
    t = np.arange(count)
    noise = noise_std * np.random.default_rng(0).standard_normal(count)
    return step * np.round((np.sin(0.02 * t) + 0.3 * np.sin(0.071 * t) + noise) / step)


@pytest.mark.parametrize('step', [STEP, 1e-3, 2.0**-12])
def test_the_step_of_an_encoder_is_found(step: float) -> None:
    y = readings(step)
    y[::7] = np.nan
    assert resolution_of(y) == pytest.approx(step, rel=1e-9)


def test_an_encoder_that_does_not_read_0_at_0_has_a_step_as_well() -> None:
    assert resolution_of(readings(STEP) + 0.1234567) == pytest.approx(STEP, rel=1e-6)


@pytest.mark.parametrize('y', [
    np.sin(0.02 * np.arange(400)), readings(0.2), np.zeros(400), np.full(400, np.nan),
    np.append(readings(STEP), 0.5 * STEP / 1.7),
], ids=['no steps', 'few of them', 'rest', 'nothing', 'one that is none'])
def test_readings_without_steps_have_no_resolution(y: np.ndarray) -> None:
    assert resolution_of(y) == 0.0


@given(st.floats(-3.0, 3.0), st.floats(0.02, 0.5))
def test_likelihood_and_its_derivatives(off: float, noise_std: float) -> None:
    one = np.array([off])
    upper, lower = (off + 0.5) / noise_std, (off - 0.5) / noise_std
    # By the tail in which it is.
    exact = norm.sf(lower) - norm.sf(upper) if lower > 0.0 else norm.cdf(upper) - norm.cdf(lower)
    said = cells(one, 1.0, noise_std)
    if exact > 1e-200:
        assert said.likelihood[0] == pytest.approx(np.log(exact), rel=1e-6, abs=1e-9)
    d = 1e-4 * noise_std
    further, nearer = (cells(one + by, 1.0, noise_std) for by in (d, -d))
    # r = y - output: the derivative by the output is minus that by r.
    slope = (nearer.likelihood - further.likelihood)[0] / (2.0 * d)
    assert said.score[0] == pytest.approx(slope, rel=1e-3, abs=1e-3 / noise_std)
    curvature = (further.score - nearer.score)[0] / (2.0 * d)
    least = information_of(1.0, noise_std)
    assert said.information[0] == pytest.approx(max(curvature, least), rel=0.01)


def test_far_outside_of_its_interval_a_reading_is_as_good_as_exact() -> None:
    said = cells(np.array([1e3, -1e5]), 1.0, 0.05)
    assert said.information == pytest.approx(1.0 / 0.05**2)
    assert np.isfinite(said.likelihood).all()
    assert np.isfinite(said.score).all()


@pytest.mark.parametrize('noise_std', [0.5, 0.25, 1.0 / 16.0])
def test_information_is_the_mean_square_of_the_score(noise_std: float) -> None:
    def at(output: float) -> float:
        read = np.arange(-8.0, 9.0)
        said = cells(read - output, 1.0, noise_std)
        return float(np.exp(said.likelihood) @ said.score**2)

    mean, _ = integrate.quad(at, -0.5, 0.5, limit=200)
    assert information_of(1.0, noise_std) == pytest.approx(mean, rel=1e-3)


def test_less_noise_lets_a_rounded_reading_tell_more() -> None:
    as_values = 1.0 / (1.0 / 12.0 + 0.5**2)
    assert information_of(1.0, 0.5) == pytest.approx(as_values, rel=0.01)
    assert information_of(1.0, 1.0 / 16.0) > 2.0 * 12.0
