"""A position loop in front of the gap: its effect on y and the crossings, made up for."""

from collections.abc import Callable

import numpy as np
import pytest

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop

LAG = TransferFunction((0.05, 0.05), (1.0, -1.6, 0.65), 'actuator')  # gain 2
ACTUATOR = Actuator(LAG, (0.3, 0.2))
MODEL = TransferFunction((0.3, 0.2), (1.0, -0.6, 0.1))
PARAMETERS = {
    'actuator.numerator': (0.05, 0.05), 'actuator.denominator': (1.0, -1.6, 0.65),
    'actuator.wind_up': (0.3, 0.2),
}


def response_to(commands: list[float]) -> np.ndarray:
    plant = build_plant(Parameters({
        **PARAMETERS, 'plant.numerator': (0.3, 0.2), 'plant.denominator': (1.0, -0.6, 0.1),
        'backlash.m': 1.0, 'backlash.c_r': 1.0, 'backlash.c_l': -0.5,
    }))
    y = []
    for command in commands:
        y.append(plant.measure())
        plant.step(command)
    return np.array(y)


def test_a_command_beyond_its_crossing_moves_y_and_within_does_not() -> None:
    c_r, c_l = ACTUATOR.crossings(1.0, -0.5)
    assert (c_r, c_l) == pytest.approx((0.8, -0.45))
    gain = 2.0 * MODEL.numerator.sum() / MODEL.denominator.sum()
    top = c_r + 1.0

    def rests_at(lowest: float) -> float:
        ways = [(0.0, top), (top, top), (top, lowest), (lowest, lowest)]
        commands = [np.linspace(a, b, 400) for a, b in ways]
        return float(response_to(np.concatenate(commands).tolist())[-1])

    assert rests_at(top) == pytest.approx(gain, rel=1e-3)
    across = top - (c_r - c_l)
    assert rests_at(across + 0.01) == pytest.approx(gain, rel=1e-3)
    assert rests_at(across - 0.1) == pytest.approx(0.9 * gain, rel=1e-3)


@pytest.mark.parametrize(('changes', 'text'), [
    ({'actuator.denominator': (1.0, -2.1, 1.1)}, 'actuator.denominator.*within the unit circle'),
    ({'actuator.numerator': (-0.1,)}, 'actuator.numerator.*must be > 0'),
    ({'actuator.numerator': ()}, 'actuator.numerator.*at least one number'),
    ({'actuator.numerator': (1.0, 0.0, 0.0)}, 'actuator.numerator.*must be below the degree'),
])
def test_an_actuator_that_is_none_is_refused_by_name(changes, text):
    with pytest.raises(ParameterError, match=text):
        build_controller(Parameters({**PARAMETERS, **changes}))


# A position loop with a lag of 6 samples, whose wind-up is a third of the gap behind it.
TRUE = Parameters({
    'sample_period': 0.005, 'plant.numerator': (0.3, 0.2), 'plant.denominator': (1.0, -0.6, 0.1),
    'plant.uncertainty': 0.02, 'actuator.numerator': (0.03, 0.02),
    'actuator.denominator': (1.0, -1.6, 0.65), 'actuator.wind_up': (0.05, 0.04),
    'structure': 'tracking', 'amplitude': 1.0, 'frequency': 6.0,
    'output_noise_std': 1e-4, 'estimator.use_applied_control': 'true',
    'backlash.m': 1.0, 'backlash.c_r': 0.15, 'backlash.c_l': -0.1,
    'estimator.initial.m': 0.9, 'estimator.initial.c_r': 0.01, 'estimator.initial.c_l': -0.01,
    'estimator.bounds.m': (0.3, 3.0), 'estimator.bounds.c_r': (0.0, 0.5),
    'estimator.bounds.c_l': (-0.5, 0.0),
})
IGNORANT = TRUE.replaced({
    'actuator.numerator': (), 'actuator.denominator': (), 'actuator.wind_up': (0.0, 0.0),
})
SAMPLES = 1000


def follow(
    known: Parameters, reported: Callable[[int], bool] = lambda k: True,
) -> tuple[float, Estimate]:
    """RMS of y against the delayed y_m over the second half, and the last estimate."""
    controller, plant, y_m = build_controller(known), build_plant(TRUE), build_reference(TRUE)
    applied: tuple[float, ...] = ()
    rows = []
    for k in range(SAMPLES):
        y = plant.measure()
        step = controller.step(y, y_m(k * 0.005), applied=applied if reported(k) else ())
        controller.refine()
        plant.step(step.v)
        applied = (plant.applied,)
        rows.append((y, step.y_m))
    y, asked = np.array(rows).T
    half, delay = SAMPLES // 2, controller.structure.delay
    error = float(np.sqrt(np.mean((y[half:] - asked[half - delay:SAMPLES - delay])**2)))
    return error, controller.estimator.estimate


def test_lag_and_wind_up_of_the_motor_are_made_up_for() -> None:
    error, estimate = follow(TRUE)
    ignorant, _ = follow(IGNORANT)
    assert estimate.status is Status.TRACKING
    # Behind the motor: the wind-up is no part of the estimate.
    assert (estimate.c_r, estimate.c_l) == pytest.approx((0.15, -0.1), rel=0.01)
    assert error < 0.025
    assert error < 0.4 * ignorant


def test_lost_outputs_are_stepped_over() -> None:
    loop = build_closed_loop(TRUE.replaced({'output_loss': 0.2, 'tracking.input_weight': 0.1}))
    record = loop.run(SAMPLES)
    assert record.lost_samples > 100
    y, t = record.column('y'), record.column('t')
    assert np.abs(y[t > 2.0]).max() < 1.3


def test_a_reading_that_is_none_does_not_move_the_motor() -> None:
    controller, plant, y_m = build_controller(TRUE), build_plant(TRUE), build_reference(TRUE)
    moves, v = [], 0.0
    for k in range(SAMPLES):
        y = plant.measure() + (50.0 if k in (800, 801) else 0.0)
        before, v = v, controller.step(y, y_m(k * 0.005), applied=(plant.applied,) if k else ()).v
        controller.refine()
        plant.step(v)
        moves.append(abs(v - before))
    # By more than the motion moves it, but for the gap that it crosses.
    assert max(moves[795:810]) < max(moves[500:795]) + TRUE.backlash.c_r - TRUE.backlash.c_l
