"""The G of low order that a record speaks for."""

from __future__ import annotations

import numpy as np
import pytest
from records import PERIOD_S, resonance, swing
from scipy.signal import lfilter

from backlash_ros.core.estimation.fit.low_order.family import Family, memory_of
from backlash_ros.core.estimation.fit.low_order.low_order import low_order
from backlash_ros.core.estimation.fit.low_order.output_error import OutputError
from backlash_ros.core.estimation.fit.pace import drained
from backlash_ros.core.estimation.regression.error_model import ErrorModel, build_error_model
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

NOISE = 1e-4
FREQUENCIES = 2.0 * np.pi * PERIOD_S * np.array([0.7, 1.9, 3.7])  # of the motion
Z = np.exp(1j * FREQUENCIES)


def learned(
    true: TransferFunction, told: TransferFunction, ramp: float = 0.0,
) -> TransferFunction | None:
    """What u and y of the true G make of the told one."""
    u = swing(600, seed=2)
    rng = np.random.default_rng(0)
    y = lfilter(true.numerator, true.denominator, np.append(u, 0.0))[1:]
    y = y + NOISE * rng.standard_normal(600) + ramp * np.arange(600)
    weights = np.ones(600)
    weights[:60] = 0.0
    error = build_error_model(StateModel(told), 0.2)
    problem = OutputError(told, u, y, weights, np.zeros(memory_of(told)), NOISE)
    model = told
    for _ in range(3):  # as the fit of a record does
        family = Family(model, error.around(StateModel(model)), 1.0)
        better = family.transfer_function(*drained(low_order(family, problem)), problem)
        if better is None:
            return None
        model = better
    return model


def off(model: TransferFunction, true: TransferFunction) -> float:
    """Largest relative error at the frequencies of the motion."""
    return float(np.abs(model.response(Z) / true.response(Z) - 1.0).max())


@pytest.mark.parametrize(('frequency', 'damping'), [(4.0, 0.5), (6.0, 0.5), (5.0, 0.4), (6.0, 0.6)])
def test_a_model_that_is_off_by_a_fifth_is_recovered(frequency: float, damping: float) -> None:
    told, true = resonance(), resonance(frequency, damping)
    model = learned(true, told)
    assert model is not None
    assert off(told, true) > 0.05
    assert off(model, true) <= 1e-3
    assert np.sort_complex(model.poles[np.abs(model.poles) > 0.3]) == pytest.approx(
        np.sort_complex(true.poles), abs=0.02
    )


def test_gain_at_rest_stays_as_it_is() -> None:
    true = resonance(6.0)
    louder = TransferFunction((1.3 * true.numerator).tolist(), true.denominator.tolist())
    model = learned(louder, resonance())
    assert model is not None
    one = np.ones(1)
    assert model.response(one) == pytest.approx(resonance().response(one), rel=1e-9)


def test_a_sample_of_delay_is_found() -> None:
    told = resonance()
    true = TransferFunction(told.numerator.tolist(), [*told.denominator.tolist(), 0.0])
    model = learned(true, told)
    assert model is not None
    assert off(model, true) <= 1e-3
    assert off(told, true) > 0.05


def test_an_integrator_stays_one_and_a_drift_is_not_taken_for_it() -> None:
    lag = np.exp(-PERIOD_S / 0.05)
    true_lag = np.exp(-PERIOD_S / 0.06)
    told = TransferFunction(
        [PERIOD_S * (1.0 - lag)], np.convolve([1.0, -1.0], [1.0, -lag]).tolist()
    )
    true = TransferFunction(
        [PERIOD_S * (1.0 - true_lag)], np.convolve([1.0, -1.0], [1.0, -true_lag]).tolist()
    )
    # What happened before the record: y of an integrator begins anywhere.
    model = learned(true, told)
    assert model is not None
    assert np.abs(model.poles - 1.0).min() < 1e-9
    assert off(model, true) <= 5e-3


def test_u_before_the_record_acts_on_its_first_samples() -> None:
    true = TransferFunction(resonance().numerator.tolist(), [*resonance().denominator, 0.0, 0.0])
    u = swing(700, seed=2)
    y = lfilter(true.numerator, true.denominator, np.append(u, 0.0))[1:]
    memory = memory_of(true)

    def misfit(before: np.ndarray) -> float:
        """Of the true G over samples from the middle of a motion on."""
        return OutputError(true, u[100:], y[100:], np.ones(600), before, NOISE).misfit(true)

    assert misfit(u[100 - memory:100]) < 1e-9
    assert misfit(np.zeros(memory)) > 1e3


def test_an_exact_model_stays_what_it_is() -> None:
    model = learned(resonance(), resonance())
    assert model is not None
    assert off(model, resonance()) <= 1e-3


def test_a_delay_alone_has_no_free_response() -> None:
    told = TransferFunction([0.5], [1.0, 0.0])
    true = TransferFunction([0.5], [1.0, 0.0, 0.0])
    model = learned(true, told)
    assert model is not None
    assert off(model, true) <= 1e-3


def test_prior_holds_where_rounding_makes_another_pole_of_an_integrator() -> None:
    told, other = (TransferFunction([0.1], np.poly(poles).tolist())
                   for poles in ([0.9, 0.8], [0.9, 0.8, 0.7]))
    error = ErrorModel(StateModel(told), 0.2)
    assert error.around(StateModel(other)) is error
