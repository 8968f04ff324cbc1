"""Commands that may have come too late: which of two acted is told by y."""

from __future__ import annotations

import numpy as np
import pytest
from cases.geared_motor import motor, random_backlash

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted, labelled
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.moving_horizon.moving_horizon import MovingHorizon
from backlash_ros.core.estimation.moving_horizon.refitting import refit
from backlash_ros.core.estimation.observer.observer import Observer
from backlash_ros.core.estimation.observer.record_attribution import attributed
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop

LATE = 0.07  # share of the commands that come one sample too late
SECONDS = 6.0
M, C_R, C_L, NOISE = 0.1, 0.6, -0.4, 1e-4


def worst_error(structure: str, told: bool, delay: int = 0) -> tuple[float, int]:
    """Largest relative error of c_r, c_l from 4 s on, and how many commands were re-attributed.

    told: whether the controller is told that the command before may have acted instead.
    """
    loop = build_closed_loop(Parameters({
        **motor(), **random_backlash(1), 'structure': structure, 'truth.delay_samples': delay,
    }))
    controller, plant = loop.controller, loop.plant
    estimator = controller.estimator
    assert isinstance(estimator, MovingHorizon)
    truth = plant.backlash
    rng = np.random.default_rng(4)
    before, worst = 0.0, 0.0
    instead: tuple[float, ...] = ()
    for k in range(round(SECONDS / loop.sample_period) + 1):
        t = k * loop.sample_period
        v = controller.step(plant.measure(), loop.reference(t), alternatives=instead).v
        controller.refine()
        plant.step(before if rng.random() < LATE else v)
        instead = (before,) if told else ()
        before = v
        estimate = estimator.estimate
        error = max(abs(estimate.c_r / truth.c_r - 1.0), abs(estimate.c_l / truth.c_l - 1.0))
        worst = max(worst, error) if t >= 4.0 else 0.0
    return worst, estimator.report.reattributed


@pytest.mark.parametrize(('structure', 'delay'), [
    ('proportional', 0), ('tracking', 0), ('proportional', 1),
])
def test_late_commands_cost_little_where_they_may_be_told(structure: str, delay: int) -> None:
    misled, none = worst_error(structure, told=False, delay=delay)
    right, found = worst_error(structure, told=True, delay=delay)
    assert none == 0
    assert found > 0.5 * LATE * SECONDS / 0.005
    assert right < 2e-3 < misled


def tracking_while_late(seed: int) -> float:
    """Share of the first 3 s with status TRACKING, where one command in ten is late, and told."""
    loop = build_closed_loop(Parameters({**motor(), **random_backlash(seed), 'seed': seed}))
    samples = round(3.0 / loop.sample_period) + 1
    controller, plant = loop.controller, loop.plant
    rng = np.random.default_rng(seed)
    before, tracking = 0.0, 0
    instead: tuple[float, ...] = ()
    for k in range(samples):
        y_m = loop.reference(k * loop.sample_period)
        v = controller.step(plant.measure(), y_m, alternatives=instead).v
        controller.refine()
        plant.step(before if rng.random() < 0.1 else v)
        instead, before = (before,), v
        tracking += controller.estimator.estimate.status is Status.TRACKING
    return tracking / samples


def test_late_commands_explain_samples_that_contradict() -> None:
    assert np.mean([tracking_while_late(seed) for seed in range(101, 117)]) > 0.68


def test_a_refit_takes_in_no_sample_that_was_not_compared_with_the_fit() -> None:
    loop = build_closed_loop(Parameters({**motor(), **random_backlash(1)}))
    loop.run(400)
    estimator = loop.controller.estimator
    assert isinstance(estimator, MovingHorizon)
    learning = estimator._learning
    for y in (1.0, -1.0, 2.0):
        learning.record.append(0.0, y)
    waiting, length = learning.waiting, learning.fit.fit.length
    assert waiting >= 3
    drained(refit(learning))
    assert (learning.fit.fit.length, learning.waiting) == (length, waiting)
    assert learning.fit.solution.rms < 2e-4


@pytest.mark.parametrize('delay', [1, 2])
@pytest.mark.parametrize(('outliers', 'unknown'), [([50, 200, 201, 350], []), ([], [120, 270])])
def test_what_acted_is_found_in_a_record(
    outliers: list[int], unknown: list[int], delay: int,
) -> None:
    model = StateModel(TransferFunction([0.5], [1.0, -0.5, *[0.0] * (delay - 1)]))
    rng = np.random.default_rng(3)
    sent = 5.0 * np.sin(0.1 * np.arange(400))
    before = np.append(0.0, sent[:-1])
    acted = np.where(rng.random(400) < 0.2, before, sent)
    acted[unknown] = 0.5
    p, y, state = 0.0, [], Observer(model, NOISE)
    for value in acted.tolist():
        p = min(max(p, value), value + C_R - C_L)
        y.append(state.predict(M * (p - C_R)))
    measured = np.array(y) + NOISE * rng.standard_normal(400)
    measured[outliers] += 0.1
    measured[300] = np.nan
    around = Around(build_error_model(model, 0.2), NOISE)
    start = Start(C_R - C_L, 0.0)
    # The parameters of the plant with every command as it was sent.
    true = drained(fitted(acted, np.array(y), around, start, M, Pace()))
    sent_fit = drained(labelled(sent, measured, around, true.fit.start, M, Pace())).fit
    found = drained(attributed(
        Fitted(sent_fit, true.solution), sent, measured, before, Pace()
    ))
    # While v turns, or is in the gap, one acts like the other.
    tells = np.abs(sent - before) > 0.2
    tells[unknown] = False
    wrong = np.count_nonzero((found.v != acted) & tells)
    assert np.count_nonzero((sent != acted) & tells) > 40
    assert wrong <= 4
    assert np.flatnonzero(found.outliers).tolist() == outliers
    # Commands that are neither of the two.
    assert np.flatnonzero(found.unknown).tolist() == unknown
    assert np.allclose(found.v[unknown], acted[unknown], atol=0.02)
