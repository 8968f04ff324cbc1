"""The G that may be around the one that was told, and the fit that finds it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from records import Truth, output, resonance, swing
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.fit.learned_error import Learned, error_of, likelier
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import TAPS, ErrorModel
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

MODELS = {
    'resonance': resonance(), 'integrating': TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR),
    'slow and fast': TransferFunction([0.1, 0.05], np.poly([0.99, 0.3, 0.6]).tolist()),
}
names = st.sampled_from(sorted(MODELS))
Z = np.exp(1j * np.array([0.02, 0.06, 0.2]))
NOISE, SAMPLES = 1e-4, 600


def error_around(model: TransferFunction) -> ErrorModel:
    return ErrorModel(StateModel(model), 0.2)


def around(error: ErrorModel, **known: bool) -> Around:
    return Around(error, NOISE, **known)


def fit_of(true: TransferFunction, start: Around, seed: int = 2) -> Fitted:
    truth, v = Truth(), swing(SAMPLES, seed=seed)
    y = output(true, v, truth, NOISE, seed)
    return drained(fitted(v, y, start, Start(truth.gap, truth.start(v)), truth.m, Pace()))


def delayed(model: TransferFunction, samples: int) -> TransferFunction:
    return TransferFunction(
        np.trim_zeros(model.numerator, 'f').tolist(),
        np.append(model.denominator, np.zeros(samples)).tolist(),
    )


def off(model: TransferFunction, true: TransferFunction) -> float:
    """Largest relative error where v moves."""
    return float(np.abs(model.response(Z) / true.response(Z) - 1.0).max())


@given(names, st.data())
def test_responses_are_the_derivatives_of_g(name: str, data: st.DataObject) -> None:
    error = error_around(MODELS[name])
    xi = 1e-5 * np.array(data.draw(
        st.lists(st.floats(-1.0, 1.0), min_size=error.count, max_size=error.count)
    ))
    near = error.low_order(xi)
    assert near is not None
    relative = near.response(Z) / MODELS[name].response(Z) - 1.0
    assert relative == pytest.approx(error.responses(Z) @ xi, abs=1e-7)


@given(names, st.data())
def test_a_moved_model_knows_where_the_told_one_is(name: str, data: st.DataObject) -> None:
    error = error_around(MODELS[name])
    xi = np.array(data.draw(
        st.lists(st.floats(-1.0, 1.0), min_size=error.count, max_size=error.count)
    ))
    moved = error.moved(xi)
    assert moved.told[TAPS:] == pytest.approx(-xi[TAPS:])
    back = moved.low_order(moved.told)
    assert back is not None
    assert off(back, MODELS[name]) <= 1e-9
    # The gain at rest, or of velocity, is that of the told one wherever the poles are.
    low = np.array([np.exp(1e-6j)])
    gain = moved.model.transfer_function.response(low) / MODELS[name].response(low)
    assert np.abs(gain) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize('samples', [1, 2])
def test_a_later_model_is_the_same_one_later(samples: int) -> None:
    later = error_around(resonance()).later(samples).model.transfer_function
    assert later.response(Z) == pytest.approx(resonance().response(Z) * Z ** -samples)


@pytest.mark.parametrize(('frequency', 'damping', 'late'), [
    (4.0, 0.5, 0), (6.0, 0.5, 0), (5.0, 0.4, 0), (6.0, 0.6, 0),
    (5.0, 0.5, 1), (5.0, 0.5, 4), (4.0, 0.6, 2),
])
def test_the_fit_finds_the_poles_and_the_delay(frequency: float, damping: float, late: int) -> None:
    true = delayed(resonance(frequency, damping), late)
    result = fit_of(true, around(error_around(resonance())))
    assert off(resonance(), true) > 0.05
    xi, _ = error_of(result.fit, result.solution)
    found = result.around.error.low_order(xi)
    assert found is not None
    assert off(found, true) <= 2e-3
    assert result.around.model.transfer_function.delay == true.delay
    # What is left of the error is small: first order is enough.
    assert np.abs(xi[TAPS:]).max() <= 0.1
    assert result.solution.theta == pytest.approx(Truth().theta, rel=2e-3)


def test_a_model_that_was_identified_with_the_backlash_stays() -> None:
    error = error_around(resonance())
    result = fit_of(resonance(6.0), around(error, inherited=True))
    assert result.around.error is error


def test_an_exact_model_stays() -> None:
    error = error_around(resonance())
    assert fit_of(resonance(), around(error)).around.error is error


def test_the_likelier_model_is_taken_up_once() -> None:
    error = error_around(resonance())
    told = Learned(error.model, np.zeros(error.count), 0)
    result = fit_of(resonance(6.0), around(error))
    learned = likelier(result.fit, result.solution, told)
    assert learned.samples == SAMPLES
    assert off(learned.model.transfer_function, resonance(6.0)) <= 2e-3
    assert likelier(result.fit, result.solution, learned) is learned
    same = fit_of(resonance(), around(error))
    # By less than chance it is no other one.
    known = told._replace(samples=SAMPLES)
    assert likelier(same.fit, same.solution, known) is known
