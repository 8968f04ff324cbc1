"""The observer between two solutions against the stationary Kalman filter."""

import numpy as np
import pytest
from records import resonance
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.observer import RATIOS, REGULAR, Observer, gain_of
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

MODELS = {
    'resonance': StateModel(resonance()),
    'integrating': StateModel(TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)),
    'delayed': StateModel(TransferFunction([0.2, 0.1], [1.0, -0.7, 0.0, 0.0])),
}
NOISE = 1e-3


def stationary(model: StateModel, ratio: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Gain, variance of the innovation and covariance of x, by iterating the Kalman filter.

    In units of the variance of y.
    """
    power = abs(model.transfer_function.response(np.exp([0.1j * np.pi]))[0])
    noise = np.outer(model.b, model.b) * (ratio / power) ** 2
    noise += REGULAR * np.trace(noise) * np.eye(model.order)
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
    assert found is not None
    gain, variance, cov = stationary(model, ratio)
    assert model.to_state @ found.gain == pytest.approx(gain, rel=1e-3, abs=1e-4 * max(abs(gain)))
    assert found.innovation**2 == pytest.approx(variance, rel=1e-3)
    assert found.cov == pytest.approx(cov, rel=1e-2, abs=1e-3 * np.trace(cov))


def follow(observer: Observer, disturbance: float, samples: int, seed: int = 0) -> np.ndarray:
    """Errors of the prediction of y for a plant whose u is disturbed, settling now and then."""
    model = observer.model
    rng = np.random.default_rng(seed)
    power = abs(model.transfer_function.response(np.exp([0.1j * np.pi]))[0])
    x = np.zeros(model.order)
    errors = []
    for k in range(samples):
        u = float(np.sin(0.05 * k))
        x = model.a @ x + model.b * (u + disturbance / power * rng.standard_normal())
        y = model.c * x[0] + NOISE * rng.standard_normal()
        expected = observer.predict(u)
        observer.correct(y - expected)
        errors.append(y - expected)
        if k % 50 == 49:
            observer.settle(NOISE)
    return np.array(errors)


def followed_by_another_model(disturbance: float) -> float:
    """Size of the state's covariance in that of an observer which knows nothing before."""
    before, model = Observer(MODELS['resonance'], NOISE), MODELS['delayed']
    follow(before, disturbance, 3000)
    after = Observer(model, NOISE, before)
    return float(np.trace(after.noise_cov) / np.trace(Observer(model, NOISE).noise_cov))


def test_another_model_of_the_same_plant_begins_with_the_gain_that_has_settled() -> None:
    assert followed_by_another_model(0.0) < 0.1


def test_a_gain_that_a_wrong_model_has_raised_is_not_inherited() -> None:
    assert followed_by_another_model(100.0) == pytest.approx(1.0)
