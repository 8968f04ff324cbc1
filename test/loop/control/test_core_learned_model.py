"""What the controller believes of G, before and after it has learned."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.assembly import build_model, build_true_model
from backlash_ros.core.law import LawReport
from backlash_ros.core.loop.learned_model import (
    FREQUENCIES,
    LearnedModel,
    from_fields,
    learned_model_of,
)
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import ClosedLoop, build_closed_loop

MOTOR = Parameters({
    'sample_period': 0.005, 'plant.numerator': [0.1513, 0.1325],
    'plant.denominator': [1.0, -1.3834, 0.6672], 'plant.uncertainty': 0.2,
    'backlash.m': 1.3, 'backlash.c_r': 0.6, 'backlash.c_l': -0.4,
    'waveform': 'multisine', 'amplitude': 3.0, 'frequency': 4.0, 'output_noise_std': 1e-3,
    'estimator.output_noise_std': 1e-3,
})


def learned(loop: ClosedLoop) -> LearnedModel:
    return learned_model_of(loop.controller.estimator, loop.told)


def report(loop: ClosedLoop) -> LawReport:
    return loop.controller.estimator.report


@given(
    st.lists(st.floats(0.1, 1.0), min_size=1, max_size=4), st.floats(-0.9, 0.9),
    st.integers(0, 3), st.integers(0, 3),
)
def test_a_model_without_its_delay_is_the_same_with_it(taps, pole, delay, more):
    denominator = [1.0, -pole, *[0.0] * (delay + len(taps))]
    model = TransferFunction(taps, denominator[:max(len(taps) + 1, len(denominator) - more)])
    numerator, rest, samples = model.without_delay()
    z = np.exp(1j * np.array([0.1, 1.0, 3.0]))
    # What is left is a G(z) that one may be told: it takes a sample at least.
    again = TransferFunction(numerator, rest)
    assert z**-samples * again.response(z) == pytest.approx(model.response(z), rel=1e-9)
    assert again.delay == 1 or again.denominator[-1] != 0.0


def test_what_was_learned_is_as_sure_as_it_says() -> None:
    p = MOTOR.replaced({'truth.scale_frequency': 1.1, 'output_noise_std': 2e-3})
    found = build_closed_loop(p).run(1200).learned
    assert found is not None
    assert found.denominator != p.plant.denominator
    z = np.exp(2j * np.pi * np.array(FREQUENCIES))
    gain = [build_true_model(p).response(np.ones(1, complex)), build_model(p).response(
        np.ones(1, complex))]
    response = TransferFunction(found.numerator, found.denominator).response(z) \
        * z**-found.delay_samples
    off = np.abs(build_true_model(p).response(z) / gain[0] * gain[1] / response - 1.0)
    assert np.all(off <= 3.0 * np.array(found.response_std))
    assert found.noise_ratio == pytest.approx(2.0, rel=0.1)
    assert 0.0 <= found.unexplained < 0.05


@given(st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=4), st.integers(0, 5))
def test_fields_hold_all(numbers: list[float], delay: int) -> None:
    model = LearnedModel(
        tuple(numbers), (1.0, *numbers), delay, (0.1, 0.2, 0.3, 0.4, 0.5), 1.1, 0.02
    )
    assert from_fields(model.fields()) == model
    missing = {k: v for k, v in model.fields().items() if k != 'unexplained'}
    with pytest.raises(KeyError):
        from_fields(missing)


def test_wrong_sign_is_told_until_there_is_an_estimate() -> None:
    turned = {
        'truth.numerator': [-b for b in MOTOR.plant.numerator],
        'truth.denominator': list(MOTOR.plant.denominator),
    }
    loop = build_closed_loop(MOTOR.replaced(turned))
    assert not report(loop).wrong_sign
    loop.run(400)
    assert report(loop).wrong_sign
    # Somebody turns the sensor.
    measure = loop.plant.measure
    loop.plant.measure = lambda: -measure()  # type: ignore[method-assign]
    loop.run(800)
    assert loop.controller.estimator.estimate.learned
    assert not report(loop).wrong_sign
