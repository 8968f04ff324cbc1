"""The gradient law of the four-block loop."""

import pytest

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord

TRUTH = {'m': 1.3, 'c_r': 3.0, 'c_l': -3.0}


def four_blocks(**changes: object) -> Parameters:
    named = {name.replace('__', '.'): value for name, value in changes.items()}
    return Parameters({
        'structure': 'pole_placement', 'estimator.law': 'gradient', 'amplitude': 0.2, **named,
    })


def last(run: RunRecord) -> dict[str, float]:
    return {name: float(run.column(name)[-1]) for name in TRUTH}


@pytest.mark.parametrize('amplitude', [0.05, 0.2, 1.0])
def test_learns_all_three_from_the_tracking_error(amplitude: float) -> None:
    run = build_closed_loop(four_blocks(amplitude=amplitude)).run(2000)
    assert last(run) == pytest.approx(TRUTH, rel=0.01)


def test_says_that_y_moves_against_v() -> None:
    p = four_blocks()
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    for k in range(200):
        step = controller.step(-plant.measure(), reference(k * 0.01))
        plant.step(step.v)
    assert step.estimate.status is Status.INCONSISTENT
