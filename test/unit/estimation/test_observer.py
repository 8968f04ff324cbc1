"""The observer between two solutions against the stationary Kalman filter."""

import numpy as np
import pytest
from records import resonance
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.observer import RATIOS, gain_of
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

MODELS = {
    'resonance': StateModel(resonance()),
    'integrating': StateModel(TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)),
    'delayed': StateModel(TransferFunction([0.2, 0.1], [1.0, -0.7, 0.0, 0.0])),
}


def stationary(model: StateModel, ratio: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Gain, variance of the innovation and covariance of x, by iterating the Kalman filter.

    In units of the variance of y.
    """
    power = abs(model.transfer_function.response(np.exp([0.1j * np.pi]))[0])
    noise = np.outer(model.b, model.b) * (ratio / power) ** 2
    noise += 1e-9 * np.trace(noise) * np.eye(model.order)
    c = np.zeros(model.order)
    c[0] = model.c
    p = np.eye(model.order)
    for _ in range(20_000):
        variance = c @ p @ c + 1.0
        gain = p @ c / variance
        kept = p - np.outer(gain, gain) * variance
        p = model.a @ kept @ model.a.T + noise
    return gain, float(variance), kept


@pytest.mark.parametrize('ratio', [RATIOS[3], RATIOS[4], RATIOS[6]])
@pytest.mark.parametrize('name', sorted(MODELS))
def test_gain_is_that_of_the_stationary_kalman_filter(name: str, ratio: float) -> None:
    model = MODELS[name]
    found = gain_of(model, ratio)
    gain, variance, cov = stationary(model, ratio)
    assert model.to_state @ found.gain == pytest.approx(gain, rel=1e-3, abs=1e-4 * max(abs(gain)))
    assert found.innovation**2 == pytest.approx(variance, rel=1e-3)
    assert found.cov == pytest.approx(cov, rel=1e-2, abs=1e-3 * np.trace(cov))
