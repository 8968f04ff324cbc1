"""Whoever takes over v in `tracking`, and whatever with: v goes on without a jump."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import GEAR, known_backlash

from backlash_ros.core import Parameters, build_closed_loop, build_controller
from backlash_ros.core.assembly import build_state_model
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.control.tracking.design import design, feedback_around

PARAMETERS = Parameters({
    **GEAR, **known_backlash(1.0, 0.5, -0.4), 'structure': 'tracking', 'amplitude': 1.0,
    'fixed.doubt': 0.1, 'frequency': 4.0,
    'estimator.output_noise_std': 1e-4, 'output_noise_std': 1e-4,
})
GAP = 0.9


def restarted(core: AdaptiveController) -> AdaptiveController:
    new = build_controller(PARAMETERS, core.estimator.estimate)
    new.go_on_from(core)
    return new


def with_other_weights(core: AdaptiveController) -> AdaptiveController:
    core.retune(PARAMETERS.replaced({'tracking.input_weight': 0.1}))
    return core


def with_other_gains(core: AdaptiveController) -> AdaptiveController:
    p = PARAMETERS
    heavier = p.tracking._replace(input_weight=0.1)
    core.structure.adopt(design(build_state_model(p), heavier), core.estimator)
    return core


def with_another_estimate(core: AdaptiveController) -> AdaptiveController:
    core.estimator.estimate = replace(core.estimator.estimate, m=0.98, c_r=0.51)
    return core


def after_a_rival(core: AdaptiveController) -> AdaptiveController:
    new = restarted(core)
    new.start_from(core.motion.v + 0.1)
    return new


@pytest.mark.parametrize('take_over', [
    restarted, with_other_weights, with_other_gains, with_another_estimate, after_a_rival,
])
@pytest.mark.parametrize('at', [430, 505, 590])
def test_v_goes_on_as_it_moved(take_over, at):
    loop, v = build_closed_loop(PARAMETERS), [0.0]
    for k in range(at + 20):
        if k == at:
            loop.controller = take_over(loop.controller)
            v[-1] = loop.controller.motion.v
        step = loop.controller.step(loop.plant.measure(), loop.reference(k * loop.p.sample_period))
        loop.plant.step(step.v)
        v.append(step.v)
    moves = np.abs(np.diff(v))
    usual = np.sort(moves[at - 200:at])[-5]  # the gap is crossed once or twice
    assert usual < 0.1 * GAP
    assert moves[at] <= 2.0 * usual, 'at once'
    assert np.median(moves[at:at + 8]) <= 3.0 * usual, 'while the difference fades'


def test_other_tuning_leaves_feedback_as_soft_as_a_better_g_has_made_it():
    p, state, softer = PARAMETERS, build_state_model(PARAMETERS), 3.0
    core = build_controller(p)
    core.structure.adopt(design(state, p.tracking, softer), core.estimator)
    core.retune(p.replaced({'inverse.caution': 2.0}))
    gains = core.structure.trajectory.design.feedback.state
    assert gains == pytest.approx(feedback_around(state, p.tracking, softer).state)
    assert gains != pytest.approx(feedback_around(state, p.tracking).state)
