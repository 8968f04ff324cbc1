"""The G(z) of a simulated plant that differs from the known one."""

from math import pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter
from strategies import plants

from backlash_ros.core.assembly import build_model, build_plant, build_true_model
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.simulated_plant import altered_plant
from backlash_ros.core.plant.transfer_function import TransferFunction

PERIOD = 0.005


def motor(frequency: float = 20.0, damping: float = 0.5) -> TransferFunction:
    """The load of geared_motor.yaml by an independent discretisation."""
    w = 2.0 * pi * frequency
    numerator, denominator, _ = cont2discrete(
        ([w * w], [1.0, 2.0 * damping * w, w * w]), PERIOD, 'zoh'
    )
    return TransferFunction(np.ravel(numerator).tolist(), denominator.tolist())


def assert_equal(found: TransferFunction, expected: TransferFunction, tolerance: float) -> None:
    np.testing.assert_allclose(found.numerator, expected.numerator, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.denominator, expected.denominator, rtol=0.0, atol=tolerance)


def step_response(model: TransferFunction, samples: int) -> NDArray[np.float64]:
    return np.asarray(lfilter(model.numerator, model.denominator, np.ones(samples)))


def continuous(model: TransferFunction) -> bool:
    poles = model.poles
    return not np.any((poles.real <= 0.0) & (np.abs(poles.imag) < 1e-3))


@pytest.mark.parametrize('factor', [0.5, 0.8, 0.98, 1.02, 1.2, 1.5])
def test_scaled_frequency_is_the_motor_at_that_frequency(factor: float) -> None:
    assert_equal(altered_plant(motor(), frequency=factor), motor(20.0 * factor), 1e-12)


@given(plants(), st.integers(0, 2), st.integers(1, 3))
def test_lag_by_a_part_of_a_sample_shifts_the_response_by_that_part(model, whole, quarters):
    assume(continuous(model))
    lagging = step_response(altered_plant(model, lag=whole + 0.25 * quarters), 60)
    # A quarter of the frequency shows the response between the samples as well.
    slow = step_response(altered_plant(model, frequency=0.25), 240)
    if np.any(np.abs(model.poles - 1.0) < 1e-6):
        slow = slow * 0.25
    expected = np.append(np.zeros(whole + 1), slow[4 - quarters::4])[:60]
    np.testing.assert_allclose(lagging, expected, rtol=0.0, atol=1e-7 * np.abs(slow).max())


def test_plant_that_no_continuous_one_has_is_refused_with_its_pole() -> None:
    ringing = TransferFunction([1.0], [1.0, 0.25])
    with pytest.raises(ParameterError, match=r'pole -0\.25.*negative real axis.*truth\.numerator'):
        altered_plant(ringing, frequency=1.2)
    # Whole samples of dead time need no continuous plant.
    assert altered_plant(ringing, lag=2.0).delay == 3


def test_given_plant_takes_the_place_of_the_known_one_in_the_simulation_alone() -> None:
    known = Parameters({'control.delay_samples': 1})
    p = known.replaced({
        'truth.numerator': [0.3], 'truth.denominator': [1.0, -0.5, 0.06], 'truth.delay_samples': 3,
    })
    assert_equal(
        build_true_model(p), TransferFunction([0.3], [1.0, -0.5, 0.06, 0.0, 0.0, 0.0]), 0.0
    )
    assert_equal(build_model(p), build_model(known), 0.0)
    denominator = p.replaced({'truth.numerator': [], 'truth.denominator': [1.0, -2.8, 2.7, -0.9]})
    assert build_true_model(denominator).numerator.max() == max(p.plant.numerator)


def test_bad_truth_is_named_as_such() -> None:
    with pytest.raises(ParameterError, match=r'truth\.numerator=.* of truth\.denominator'):
        build_plant(Parameters({'truth.numerator': [1.0, 2.0], 'truth.denominator': [1.0, 0.5]}))
