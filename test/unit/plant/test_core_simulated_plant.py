"""The simulated plant: backlash, G(z), sensor (3.1)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import output_of, paper_example, plants, signals, usual_plays

from backlash_ros.core.assembly import build_plant
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.simulated_plant import SimulatedPlant
from backlash_ros.core.plant.transfer_function import TransferFunction

SLOW = TransferFunction([0.1], [1.0, -0.9])


def plant(**values: object) -> SimulatedPlant:
    return SimulatedPlant(Parameters(values), SLOW)


def outputs(simulated: SimulatedPlant, control: list[float]) -> list[float]:
    result = []
    for v in control:
        result.append(simulated.measure())
        simulated.step(v)
    return result


@given(model=plants(), play=usual_plays(), control=signals(), disturbance=st.floats(-5.0, 5.0))
def test_y_is_g_of_the_backlash_output_plus_the_disturbance(model, play, control, disturbance):
    simulated = SimulatedPlant(Parameters({
        'backlash.m': play.m, 'backlash.c_r': play.c_r, 'backlash.c_l': play.c_l,
        'input_disturbance': disturbance,
    }), model)
    backlash = Backlash(play.m, play.c_r, play.c_l)
    u = np.array([backlash.step(v) for v in control])
    expected = output_of(model, u + disturbance)
    np.testing.assert_allclose(
        outputs(simulated, control), expected, atol=1e-9 * (1.0 + np.abs(expected).max())
    )


@given(control=signals(), quantum=st.floats(0.001, 1.0))
def test_quantised_output_is_the_nearest_multiple(control: list[float], quantum: float) -> None:
    exact = outputs(plant(), control)
    coarse = outputs(plant(output_quantum=quantum), control)
    for y, shown in zip(exact, coarse, strict=True):
        assert abs(shown - y) <= 0.5 * quantum * (1.0 + 1e-9)
        assert shown / quantum == pytest.approx(round(shown / quantum), abs=1e-6)


def test_wear_moves_the_backlash_with_time_and_the_jump_comes_at_its_time() -> None:
    simulated = plant(**{
        'backlash.rate': (0.1, 1.0, -2.0), 'backlash.jump_time': 0.5,
        'backlash.jump': (0.0, 1.0, 0.0), 'sample_period': 0.1,
    })
    seen = []
    for _ in range(11):
        simulated.step(0.0)
        seen.append((simulated.backlash.m, simulated.backlash.c_r, simulated.backlash.c_l))
    assert seen[0] == pytest.approx((1.3, 3.0, -3.0))
    assert seen[4] == pytest.approx((1.34, 3.4, -3.8))
    assert seen[5] == pytest.approx((1.35, 4.5, -4.0))
    assert seen[10] == pytest.approx((1.4, 5.0, -5.0))


@pytest.mark.parametrize('changes', [
    {'backlash__jump': [-2.0, 0.0, 0.0]}, {'backlash__jump': [0.0, -3.0, 3.0]},
    {'backlash__rate': [-1.0, 0.0, 0.0]},
], ids=['jump to m < 0', 'jump to c_l = c_r', 'm falls below 0 after 1.3 s'])
def test_wear_never_ends_in_an_invalid_backlash(changes: dict[str, list[float]]) -> None:
    """It is refused at the start, or when it gets there, but never simulated."""
    with pytest.raises(ParameterError) as refusal:
        outputs(build_plant(paper_example(**changes)), [0.0] * 400)
    assert refusal.value.name.startswith('backlash.')
