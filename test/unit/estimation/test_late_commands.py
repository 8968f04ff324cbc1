"""Commands that came a sample late: which of them, and what is learned in spite of it."""

import numpy as np
import pytest
from numpy.typing import NDArray

from backlash_ros.core import Parameters, Status, build_controller, build_reference
from backlash_ros.core.estimation.explanations import Setup, afresh
from backlash_ros.core.estimation.late_commands import likelier, weighed
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.parameters import Bounds
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.scenario import build_plant
from backlash_ros.core.window import Window

M, C_R, C_L, NOISE = 1.3, 3.0, -3.0, 1e-3
COUNT = 300
# It integrates: what a late command does to y grows for long, and stays.
FAMILY = PlantFamily(TransferFunction([1e-5, 4e-5, 1e-5], [1.0, -2.88504, 2.77196, -0.88692]), 0.0)
SETUP = Setup(FAMILY, NOISE, Bounds((0.1, 10.0), (0.0, 10.0), (-10.0, 0.0)), 20.0, 6.0, 0.0,
              np.zeros(3))


def record(late: frozenset[int], seed: int) -> Window:
    """Commands as they were sent, and y; those of the samples `late` acted one sample later."""
    rng = np.random.default_rng(seed)
    sent = np.cumsum(np.where(np.arange(COUNT) % 80 < 40, 1.0, -1.0) * rng.exponential(10.0, COUNT))
    before = np.append(np.nan, sent[:-1])
    acted = sent.copy()
    acted[list(late)] = before[list(late)]
    p = play(acted, C_R - C_L, acted[0])
    y = lfilter(*FAMILY.at([]), M * (p - C_R)) + rng.normal(0.0, NOISE, COUNT)
    return Window(0, sent, y, before)


@pytest.mark.parametrize('late', [(269,), (262, 268), (247, 290), (255, 256, 276)])
def test_the_very_commands_that_were_late_are_found(late: tuple[int, ...]) -> None:
    """Not another one that explains y nearly as well, as a single one between two of them does."""
    sent = record(frozenset(late), 1)
    fit = afresh(SETUP, sent.between(0, min(late)))
    assert fit is not None
    acted, found = likelier(SETUP, sent, fit, frozenset(), None)
    assert sorted(found) == list(late)
    np.testing.assert_array_equal(acted.v[list(late)], sent.other[list(late)])


@pytest.mark.parametrize('seed', range(6))
def test_what_seemed_late_at_first_is_taken_back_for_what_was(seed: int) -> None:
    late = frozenset({262, 268})
    sent = record(late, seed)
    fit = afresh(SETUP, sent.between(0, 260))
    assert fit is not None
    now, found = sent, frozenset[int]()
    for end in (272, 280, 300):
        found = likelier(SETUP, now.between(0, end), fit, found, None)[1]
        now = sent.swapped(found)
    assert found == late


def test_nothing_is_late_where_every_command_was_in_time() -> None:
    sent = record(frozenset(), 2)
    fit = afresh(SETUP, sent)
    assert fit is not None
    assert likelier(SETUP, sent, fit, frozenset(), None)[1] == frozenset()


def run(seed: int, samples: int) -> tuple[list[Status], NDArray[np.float64]]:
    """Statuses, and relative errors of m, c_r, c_l, where one of 100 commands is late."""
    p = Parameters({'structure': 'tracking', 'output_noise_std': NOISE,
                    'estimator.output_noise_std': NOISE, 'seed': seed})
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    rng, states, before, v = np.random.default_rng(seed), [], 0.0, 0.0
    for k in range(samples):
        answer = controller.step(
            plant.measure(), reference(k * p.sample_period), alternatives=[before])
        states.append(answer.estimate.status)
        before, v = v, answer.v
        plant.step(before if rng.random() < 0.01 else v)
        controller.refine()
    e = controller.estimator.estimate
    return states, np.array([e.m / M - 1.0, e.c_r / C_R - 1.0, e.c_l / C_L - 1.0])


@pytest.mark.parametrize('seed', [2, 4])
def test_late_commands_around_an_integrator_do_not_mislead(seed: int) -> None:
    states, errors = run(seed, 1500)
    assert Status.INCONSISTENT not in states
    assert states[-1] is Status.TRACKING
    assert np.abs(errors).max() < 5e-3


@pytest.mark.parametrize('late', [False, True])
def test_commands_that_look_late_are_weighed_against_those_expected(late: bool) -> None:
    rng = np.random.default_rng(5)
    v = np.cumsum(rng.normal(0.0, 0.6, 160))
    other = np.append(np.nan, v[:-1])
    v[100], other[100] = (v[99], v[100]) if late else (v[100], v[99])
    family = PlantFamily(TransferFunction([0.3], [1.0, -0.7]), 0.0)
    y = lfilter([0.3], [1.0, -0.7], play(v, 1.0, v[0]) - 0.5) + rng.normal(0.0, 0.05, len(v))
    setup = Setup(family, 0.05, Bounds((0.1, 10.0), (-5.0, 5.0), (-5.0, 5.0)), 10.0, 1.0, 0.0,
                  np.zeros(3))
    looked = Window(0, v, y, other) if late else Window(0, v, y, other).swapped(frozenset({100}))
    fit = afresh(setup, looked)
    assert fit is not None
    record, found, swapped = weighed(setup, looked, fit, frozenset({100}), None)
    assert swapped == (frozenset({100}) if late else frozenset())
    np.testing.assert_array_equal(record.v, v)
    assert abs(found.gap - 1.0) < 5.0 * found.gap_std < 0.5
