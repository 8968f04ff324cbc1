"""A position loop in front of the gap: what it makes of a command, and of crossings behind it."""

import numpy as np
import pytest

from backlash_ros.core.assembly import build_controller, build_plant
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.transfer_function import TransferFunction

LAG = TransferFunction((0.05, 0.05), (1.0, -1.6, 0.65), 'actuator')  # gain 2
ACTUATOR = Actuator(LAG, (0.3, 0.2))
MODEL = TransferFunction((0.3, 0.2), (1.0, -0.6, 0.1))
PARAMETERS = {
    'actuator.numerator': (0.05, 0.05), 'actuator.denominator': (1.0, -1.6, 0.65),
    'actuator.wind_up': (0.3, 0.2),
}


def response_to(commands: list[float]) -> np.ndarray:
    """y of the simulated plant."""
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
        """y after a slow way up to the top and down from there."""
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
