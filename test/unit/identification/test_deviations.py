"""Deviations of a fit: those of the posterior for white noise, wider for noise that lasts."""

import numpy as np
import pytest
from scipy.signal import lfilter

from backlash_ros.core.identification.deviations import by_model, covariance_of
from backlash_ros.core.identification.structure import Samples, Structure, first_model, fitted
from backlash_ros.core.plant.backlash import play


def std_of_gap(noise: np.ndarray) -> tuple[float, float]:
    """By the correlated residual and by the posterior."""
    v = np.sin(0.05 * np.arange(len(noise)))
    y = lfilter([0.0, 0.3], [1.0, -0.7], play(v, 0.3, 0.1)) + noise
    samples, structure = Samples(v, y, 1, len(v), 0.0), Structure(1, 0, False)
    found = fitted(samples, structure, first_model(samples, structure, 0.25, 0.1).fit)
    matrix = covariance_of(found.problem, found.fit)
    return matrix[2, 2] ** 0.5, found.fit.cov[2, 2] ** 0.5


def test_noise_that_lasts_leaves_a_wider_gap_than_white_noise() -> None:
    white = 0.01 * np.random.default_rng(1).standard_normal(1500)
    own, posterior = std_of_gap(white)
    assert own == pytest.approx(posterior, rel=0.5)
    lasting = lfilter([0.3], [1.0, -0.9], white)
    own, posterior = std_of_gap(lasting)
    assert own > 1.5 * posterior


def test_models_that_fit_alike_tell_a_deviation_and_others_none() -> None:
    assert by_model(1.0, [(1.2, -3.0), (1.3, 4.0), (9.0, 4.1)]) == pytest.approx(0.2)
    assert by_model(1.0, []) == 0.0
