"""How wrong the response of G may still be, as the fit of a record has it."""

from __future__ import annotations

import numpy as np
import pytest
from records import Truth, output, resonance, swing
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.fit.learned_error import response_std
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import ErrorFilter, ErrorModel
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.loop.learned_model import FREQUENCIES
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = np.ndarray

MODELS = {
    'resonance': resonance(), 'integrating': TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR),
    'no moving pole': TransferFunction([0.5, 0.5], [1.0, 0.0, 0.0]),
}
POINTS = np.exp(2j * np.pi * np.array(FREQUENCIES))
TRUTH = Truth()
NOISE = 1e-3
LENGTH = 4000  # of the responses from which the tests tell a frequency response


def transform(response: Array) -> Array:
    """Fourier transform of responses (N, ..) at the points, shape (M, ..)."""
    return np.power.outer(POINTS, -np.arange(len(response))) @ response


def answers(error: ErrorModel, moves: Array) -> Array:
    """Outputs for each xi after moves of p (N,), shape (N, K)."""
    # They are those after each move.
    return ErrorFilter(error, 1).responses(np.append(0.0, moves[:-1])[None])[0].T


def fit_of(true: TransferFunction, told: TransferFunction, uncertainty: float) -> Fitted:
    model = StateModel(told)
    v = swing(600)
    around = Around(ErrorModel(model, uncertainty), NOISE)
    y = output(true, v, TRUTH, NOISE)
    start = Start(TRUTH.gap, TRUTH.start(v))
    return drained(fitted(v, y, around, start, TRUTH.m, Pace()))


@pytest.mark.parametrize('name', sorted(MODELS))
def test_responses_of_the_error_are_those_of_its_filters(name: str) -> None:
    error = ErrorModel(StateModel(MODELS[name]), 0.2)
    difference = np.zeros(LENGTH)
    difference[:2] = 1.0, -1.0
    assert error.responses(POINTS) == pytest.approx(
        transform(answers(error, difference)) / MODELS[name].response(POINTS)[:, None],
        rel=1e-6, abs=1e-9,
    )


def test_deviation_is_that_of_plants_drawn_from_the_posterior() -> None:
    fit, solution = fit_of(resonance(5.1), resonance(), 0.2)[:2]
    layout, posterior = fit.layout, solution.posterior
    error, model = fit.around.error, fit.model.transfer_function
    rng = np.random.default_rng(0)
    cov = posterior.cov * posterior.noise_std**2 * solution.inflation
    difference = np.zeros(LENGTH)
    difference[:2] = 1.0, -1.0
    shares = transform(answers(error, difference)) / model.response(POINTS)[:, None]
    squares = np.zeros(len(POINTS))
    # Rounding may have left it a little outside of the positive ones.
    values, axes = np.linalg.eigh(0.5 * (cov + cov.T))
    assert values.min() > -1e-9 * values.max()
    root = axes * np.sqrt(np.maximum(values, 0.0))
    draws = posterior.mean + rng.standard_normal((2000, len(values))) @ root.T
    for drawn in draws:
        m, e = drawn[layout.n + 1], drawn[layout.base:layout.base + layout.errors]
        # The record says m G (1 + Delta).
        squares += np.abs(shares @ (error.told + e / m)) ** 2
    assert response_std(fit, solution, fit.model, POINTS) == pytest.approx(
        np.sqrt(squares / len(draws)), rel=0.1
    )


@pytest.mark.parametrize('frequency_hz', [4.5, 5.0, 5.1, 5.5])
def test_true_response_lies_within_a_few_deviations(frequency_hz: float) -> None:
    true = resonance(frequency_hz)
    fit, solution = fit_of(true, resonance(), 0.2)[:2]
    for model in (resonance(), fit.model.transfer_function):
        off = np.abs(true.response(POINTS) / model.response(POINTS) - 1.0)
        std = response_std(fit, solution, StateModel(model), POINTS)
        assert np.all(off <= 3.0 * std)
        # And they are no empty promise: where y moves G is known.
        assert std[0] < 0.02 + 2.0 * off[0]


def test_deviation_is_that_from_the_model_in_question() -> None:
    true = resonance(5.2)
    fit, solution = fit_of(true, resonance(), 0.2)[:2]
    for given in (resonance(), resonance(5.5)):
        off = np.abs(true.response(POINTS) / given.response(POINTS) - 1.0)
        std = response_std(fit, solution, StateModel(given), POINTS)
        assert std[:3] == pytest.approx(off[:3], rel=0.2)
    # All that is left of the true one is what the record does not tell.
    left = response_std(fit, solution, StateModel(true), POINTS)
    assert np.all(left[:3] < 0.2 * off[:3])


def test_exact_model_has_no_deviation() -> None:
    fit, solution = fit_of(resonance(), resonance(), 0.0)[:2]
    assert response_std(fit, solution, fit.model, POINTS).tolist() == [0.0] * len(FREQUENCIES)


def test_leak_of_an_integrator_counts() -> None:
    fit, solution = fit_of(MODELS['integrating'], MODELS['integrating'], 0.2)[:2]
    layout, posterior = fit.layout, solution.posterior
    assert layout.leak
    leak = posterior.mean[layout.driven] ** 2 + posterior.cov[layout.driven, layout.driven] \
        * posterior.noise_std**2 * solution.inflation
    # Far below every other frequency only the leak is left.
    low = np.exp(1j * np.array([1e-9]))
    std = response_std(fit, solution, fit.model, low)
    assert std == pytest.approx([np.sqrt(leak) / 1e-9], rel=1e-3)
