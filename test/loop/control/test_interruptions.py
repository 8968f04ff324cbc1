"""Interruptions of a loop that has learned a G, and changes beside a fit or a design under way."""

from collections.abc import Callable
from math import sin
from typing import Any

import numpy as np
import pytest

from backlash_ros.core import Parameters, Status, build_controller
from backlash_ros.core.assembly import build_plant
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.control.tracking.design import design
from backlash_ros.core.control.tracking.feedback import shrunk_crossings
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs import Channel, Executor

TRACKING = Parameters({'structure': 'tracking', 'output_noise_std': 1e-3})
G_IS_SLOWER = TRACKING.replaced({'truth.scale_frequency': 0.85})


def reference(k: int) -> float:
    return 10.0 * sin(0.063 * k) + 3.0 * sin(0.2 * k)


class Loop:
    """A controller with a simulated plant; errors: y minus the reference that is due."""

    def __init__(self, p: Parameters, executor: Executor | None = None) -> None:
        self.p, self.plant = p, build_plant(p)
        self.controller = build_controller(p, executor=executor)
        self.errors: list[float] = []
        self.innovations: list[float] = []

    def run(self, samples: int, until: Callable[[], bool] = lambda: False) -> None:
        for _ in range(samples):
            k, y = len(self.errors), self.plant.measure()
            step = self.controller.step(y, reference(k))
            self.innovations.append(self.controller.estimator.innovation)
            self.controller.refine()
            self.plant.step(step.v)
            self.errors.append(y - reference(k - self.controller.structure.delay))
            if until():
                return

    def rms(self, last: int) -> float:
        return float(np.sqrt(np.mean(np.square(self.errors[-last:]))))


def interrupted(loop: Loop) -> AdaptiveController:
    new = build_controller(loop.p, loop.controller.estimator.estimate)
    new.go_on_from(loop.controller)
    return new


def restarted(loop: Loop) -> AdaptiveController:
    new = build_controller(loop.p, loop.controller.estimator.estimate)
    new.start_from(loop.controller.motion.v)
    return new


@pytest.mark.parametrize(
    'p', [TRACKING, G_IS_SLOWER, *(G_IS_SLOWER.replaced({'seed': seed}) for seed in (2, 3, 4, 12))])
@pytest.mark.parametrize('again', [interrupted, restarted])
def test_y_follows_after_an_interruption_as_before(p, again):
    loop = Loop(p.replaced({'plant.uncertainty': 0.2}))
    loop.run(1200)
    before = loop.rms(400)
    assert before < 0.005
    loop.controller = again(loop)
    loop.run(400)
    for _ in range(20):
        loop.run(80)
        assert loop.rms(80) < 3.0 * before
    assert loop.controller.estimator.estimate.status is Status.TRACKING


class Slow(Executor):
    """Computes at once, but gives a result only once it is told to."""

    held = False

    def open(self) -> Channel:
        executor = self

        class Held(Channel):
            def poll(self) -> Any:
                return None if executor.held else super().poll()

        return Held(self)


@pytest.mark.parametrize('structure', ['tracking', 'proportional'])
def test_a_fit_that_ends_after_learning_was_stopped_changes_nothing(structure: str) -> None:
    executor = Slow()
    loop = Loop(TRACKING.replaced({'structure': structure, 'plant.adapt': False}), executor)
    loop.run(1500)
    estimator = loop.controller.estimator
    executor.held, begun = True, len(loop.errors)
    loop.run(500, until=lambda: estimator.report.overdue > 0)
    assert len(loop.errors) < begun + 500  # a fit is under way
    estimator.adapting = False
    loop.run(100)
    held, executor.held = estimator.estimate, False
    loop.run(200)
    assert estimator.estimate == held
    assert np.abs(loop.innovations[-300:]).max() < 0.05


def test_weights_that_change_while_a_design_waits_count_for_that_design() -> None:
    as_it_was, loop = Loop(G_IS_SLOWER), Loop(G_IS_SLOWER)
    redesign, p = loop.controller.redesign, G_IS_SLOWER.replaced({'tracking.input_weight': 0.5})
    as_it_was.run(600, until=lambda: as_it_was.controller.redesign.adopted is not None)
    loop.run(len(as_it_was.errors) - 1)
    assert redesign.adopted is None
    assert redesign.considered is not None  # its gains wait
    loop.controller.retune(p)
    loop.run(600, until=lambda: redesign.adopted is not None)
    present = loop.controller.structure.trajectory.design
    assert present.model is redesign.adopted
    assert present.feedback.state == pytest.approx(
        design(present.model, p.tracking, present.factor).feedback.state)


def test_a_surprise_before_the_first_sample_of_a_record_asks_for_no_fit() -> None:
    loop = Loop(Parameters({
        'output_noise_std': 1e-4, 'proportional.f': 0.0,
        'plant.numerator': (0.157, 0.127), 'plant.denominator': (1.0, -1.25, 0.5335)}))
    controller, plant = loop.controller, loop.plant
    estimator = controller.estimator
    for k in range(2300):
        estimator.adapting = not 1500 <= k < 2000
        push = 0.5 * (k >= 2100)  # v rests since sample 1000
        step = controller.step(plant.measure() + push, 10.0 * sin(0.063 * min(k, 1000)))
        controller.refine()
        plant.step(step.v)
    assert estimator.report.failed_fits == 0


@pytest.mark.parametrize('deviations', [0.0, 1.0])
def test_a_first_guess_is_not_compensated_around_y(deviations: float) -> None:
    assert shrunk_crossings(Estimate(1.0, 0.5, -0.5, 0.0), deviations, False) == (0.0, 0.0)
