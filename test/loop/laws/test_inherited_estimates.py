"""A controller that goes on with what was learned before, and one that is told not to learn."""

import numpy as np
import pytest

from backlash_ros.core import Estimate, Parameters, Status, build_closed_loop, build_controller
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.simulation.closed_loop import ClosedLoop

EXACT = {'plant.uncertainty': 0.0}
TRUE = np.array([1.3, 3.0, -3.0])


def run(loop: ClosedLoop, controller: AdaptiveController, samples: int) -> list[Estimate]:
    estimates = []
    for _ in range(samples):
        y_m = loop.reference(loop.plant.sample * loop.p.sample_period)
        step = controller.step(loop.plant.measure(), y_m)
        controller.refine()
        loop.plant.step(step.v)
        estimates.append(step.estimate)
    return estimates


def errors(estimates: list[Estimate]) -> np.ndarray:
    values = np.array([(e.m, e.c_r, e.c_l) for e in estimates])
    return np.asarray(np.abs(values / TRUE - 1.0).max(axis=1))


@pytest.mark.parametrize(('structure', 'noise'), [('proportional', 1e-3), ('tracking', 0.0)])
def test_inherited_estimate_holds_from_the_first_sample_on(structure: str, noise: float) -> None:
    p = Parameters({**EXACT, 'structure': structure, 'output_noise_std': noise})
    loop = build_closed_loop(p)
    first = loop.controller
    learned = run(loop, first, 400)[-1]
    second = build_controller(p, learned)
    second.start_from(first.inverse.v)
    after = run(loop, second, 400)
    assert (after[0].status, after[-1].status) == (Status.ACQUIRING, Status.TRACKING)
    assert errors(after).max() < 0.05
    assert errors(after[-1:])[0] < 0.005


@pytest.mark.parametrize('law', ['moving_horizon', 'lms', 'printed', 'gradient'])
def test_held_estimates_do_not_move_and_learning_can_go_on(law: str) -> None:
    structure = 'pole_placement' if law == 'gradient' else 'proportional'
    p = Parameters({'estimator.law': law, 'structure': structure})
    loop = build_closed_loop(p)
    controller = loop.controller
    run(loop, controller, 300)
    controller.estimator.adapting = False
    held = {(e.m, e.c_r, e.c_l) for e in run(loop, controller, 200)[2:]}
    assert len(held) == 1
    controller.estimator.adapting = True
    moving = {(e.m, e.c_r, e.c_l) for e in run(loop, controller, 300)}
    # Samples that agree with what is known exactly leave the default law's estimate as it is.
    assert len(moving) > 1 or law == 'moving_horizon'
    if law in ('moving_horizon', 'lms'):
        assert errors([controller.estimator.estimate])[0] < 0.05
