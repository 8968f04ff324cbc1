"""The G that may be around the one that was told, and the fit that finds it."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from records import Truth, output, resonance, swing
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.fit.learned_error import as_told, error_of, likelier
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import TAPS, WIDEST, ErrorModel
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.plant.true_plant import Alteration, altered_plant

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
    xi[0] = abs(xi[0]) / error.spread[0, 0]  # a lag of up to a sample
    moved = error.moved(xi)
    assert moved.told == pytest.approx(-xi)
    back = moved.low_order(moved.told)
    assert back is not None
    assert off(back, MODELS[name]) <= 1e-9
    # The gain at rest, or of velocity, is that of the told one wherever the poles are.
    low = np.array([np.exp(1e-6j)])
    gain = moved.model.transfer_function.response(low) / MODELS[name].response(low)
    assert np.abs(gain) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize('name', sorted(MODELS))
@pytest.mark.parametrize('samples', [0.9, 1.7, 2.0])
def test_a_delay_moves_the_model_by_whole_samples(name: str, samples: float) -> None:
    error = error_around(MODELS[name])
    xi = np.zeros(error.count)
    xi[0] = samples / error.spread[0, 0]
    moved = error.delayed(xi)
    model = moved.model.transfer_function
    assert moved.later == round(samples)
    assert model.response(Z) == pytest.approx(MODELS[name].response(Z) * Z ** -moved.later)
    assert error.delayed(0.7 / samples * xi) is error


def test_what_acts_up_to_a_sample_late_has_a_lag_from_0_to_1() -> None:
    error = error_around(resonance())
    xi = np.zeros(error.count)
    for lag, later in ((0.95, 0), (1.05, 0), (1.5, 1), (2.05, 2), (-0.05, 0)):
        xi[0] = lag / error.spread[0, 0]
        moved = error.moved(xi)
        assert moved.later == later
        # It is the same G, however it is told.
        assert off(moved.model.transfer_function, altered_plant(
            resonance(), Alteration(lag=later)
        )) == pytest.approx(abs(lag - later) * abs(1.0 - 1.0 / Z[2]), rel=1e-6)


@pytest.mark.parametrize('late', [0.1, 0.5, 0.9])
def test_a_delay_by_a_part_of_a_sample_is_a_lag_and_a_width(late: float) -> None:
    """Of a G of second order, whose numerator has two taps, this is all of it."""
    told, true = resonance(), altered_plant(resonance(), Alteration(lag=late))
    error = error_around(told)
    b, b_true = (g.numerator[1:] / g.numerator.sum() for g in (told, true))
    lag = float(np.arange(3.0) @ b_true - np.arange(2.0) @ b[:2])
    width = float(b_true[0] - (1.0 - lag) * b[0])
    xi = np.zeros(error.count)
    xi[:TAPS] = np.array([lag, width]) / np.diag(error.spread)[:TAPS]
    near = error.low_order(xi)
    assert near is not None
    assert near.response(Z) == pytest.approx(true.response(Z), rel=1e-9)
    assert lag == pytest.approx(late, abs=1e-3)
    assert width == pytest.approx(-0.5 * late * (1.0 - late), abs=1e-2)
    assert abs(width) <= WIDEST


@pytest.mark.parametrize(('frequency', 'damping', 'late'), [
    (4.0, 0.5, 0), (6.0, 0.5, 0), (5.0, 0.4, 0), (6.0, 0.6, 0),
    (5.0, 0.5, 1), (5.0, 0.5, 4), (4.0, 0.6, 2), (5.0, 0.5, 0.2), (6.0, 0.4, 2.6),
])
def test_the_fit_finds_the_poles_and_the_delay(
    frequency: float, damping: float, late: float,
) -> None:
    true = altered_plant(resonance(frequency, damping), Alteration(lag=late))
    result = fit_of(true, around(error_around(resonance())))
    assert off(resonance(), true) > 0.03
    xi, _ = error_of(result.fit, result.solution)
    found = result.around.error.low_order(xi)
    assert found is not None
    assert off(found, true) <= 2e-3
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
    told = as_told(error.model, error.count)
    result = fit_of(resonance(6.0), around(error))
    learned = likelier(result.fit, result.solution, told)
    assert off(learned.model.transfer_function, resonance(6.0)) <= 2e-3
    assert likelier(result.fit, result.solution, learned) is learned
    # By less than chance it is no other one.
    same = fit_of(resonance(), around(error))
    known = as_told(error.model, error.count)._replace(log_det=-inf)
    assert likelier(same.fit, same.solution, known) is known


def test_a_record_that_tells_less_has_to_contradict() -> None:
    error = error_around(resonance())
    sure = as_told(error.model, error.count)._replace(log_det=-inf)
    near = fit_of(resonance(5.0003), around(error))
    assert likelier(near.fit, near.solution, sure) is sure
    far = fit_of(resonance(5.2), around(error))
    assert likelier(far.fit, far.solution, sure) is not sure
