"""The G of low order that a structure is designed for, beside the one that a fit is made around."""

from __future__ import annotations

import numpy as np
import pytest
from records import Truth, output, resonance, swing

from backlash_ros.core.estimation.fit.low_order.better_model import Refined, refined_model
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import ErrorModel
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

TRUTH, NOISE, SAMPLES, SKIPPED = Truth(), 1e-4, 600, 90
Z = np.exp(2j * np.pi * 0.005 * np.array([0.7, 1.9, 3.7]))  # where y moves
V = swing(SAMPLES)


def plant(frequency_hz: float = 5.0, delay: int = 0) -> TransferFunction:
    once = resonance(frequency_hz)
    return TransferFunction(once.numerator.tolist(), [*once.denominator.tolist(), *[0.0] * delay])


TOLD = plant()


def fit_of(
    true: TransferFunction, first: int = 0, told: TransferFunction = TOLD, uncertainty: float = 0.2,
) -> Fitted:
    """Of the record from sample `first` on, whose past is known as far as G remembers it."""
    model = StateModel(told)
    y = output(true, V, TRUTH, NOISE)
    start = Start(TRUTH.gap, TRUTH.start(V))
    if first:
        begin = max(first - 3 * model.memory, 0)
        start = start.after(V[:begin])._replace(past=V[begin:first])
    around = Around(model, ErrorModel(model, uncertainty), NOISE)
    return drained(fitted(V[first:], y[first:], around, start, TRUTH.m, Pace()))


def refined(
    true: TransferFunction, first: int = 0, told: TransferFunction = TOLD,
    present: StateModel | None = None,
) -> StateModel:
    fit = fit_of(true, first, told)
    y = output(true, V, TRUTH, NOISE)
    return drained(refined_model(
        V[first:], y[first:], fit.fit, fit.solution, Refined(present or fit.fit.model, 0),
        Pace(),
    )).model


def off(model: StateModel, true: TransferFunction) -> float:
    return float(np.abs(model.transfer_function.response(Z) / true.response(Z) - 1.0).max())


@pytest.mark.parametrize('first', [0, SKIPPED])
@pytest.mark.parametrize('delay', [0, 4])
@pytest.mark.parametrize('frequency_hz', [4.9, 5.05, 5.2])
def test_an_error_too_small_for_the_fit_to_move_is_refined(
    frequency_hz: float, delay: int, first: int,
) -> None:
    true, told = plant(frequency_hz, delay), plant(delay=delay)
    assert off(refined(true, first, told), true) < 0.02 * off(StateModel(told), true)


def test_a_model_that_does_as_well_stays() -> None:
    true = plant(5.1)
    once = refined(true)
    assert refined(true, present=once) is once
    assert refined(true, SKIPPED, present=once) is once
    assert refined(plant(5.2), present=once) is not once

