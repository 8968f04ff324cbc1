"""Explanations of a record: gaps and G that imitate each other, and beliefs after more samples."""

from dataclasses import replace

import numpy as np
import pytest
from records import two_poles

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation.belief import Belief, Known, State
from backlash_ros.core.estimation.explanations import Setup, afresh
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.state_machine import learn
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.window import Window


@pytest.mark.parametrize('seed', range(4))
def test_deviations_reach_as_far_along_the_gap_as_readings_leave_it_open(seed: int) -> None:
    # But for one sample v has two values, so that slope and gap are told apart by that one.
    b = [0.047093704, -0.111257106, 0.003570928, 0.031372878]
    family = PlantFamily(TransferFunction(
        b, [1.0, -3.571128462, 4.775346131, -2.833879626, 0.629725696]), 0.2)
    v = np.array([-5.0] * 10 + [2.0] + [3.5] * 15 + [-5.0, 3.5, 3.5, -5.0, -5.0, 3.5] + [-5.0] * 33)
    m, c_r, c_l = 0.92, 0.25, -1.2
    noise = 0.06 * np.random.default_rng(seed).standard_normal(len(v))
    y = lfilter(*family.at([0.0] * family.count), m * (play(v, c_r - c_l, -5.0 + c_r - c_l) - c_r))
    setup = Setup(family, 0.06, Parameters().estimator.bounds, 20.0, 5.4, 0.0, np.zeros(3))
    found = afresh(setup, Window(0, v, y + noise, np.full(len(v), np.nan)))
    assert found is not None
    assert abs(found.gap - (c_r - c_l)) < 4.0 * found.gap_std
    assert not setup.is_known(found)


def moved_by(
    plant: TransferFunction, told: TransferFunction, uncertainty: float, before: bool,
    count: int = 900, noise: float = 0.5,
) -> tuple[Setup, Window]:
    """A slow triangle of v, moving a gap of 1 before or behind this plant; y has an encoder.

    noise: standard deviation, in steps of the encoder.
    """
    k, step = np.arange(count), 0.01
    v = 20.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * k / 300.0))
    b, a = PlantFamily(plant, 0.0).at([])
    u = v if before else lfilter(b, a, v)
    y = play(u, 1.0, u[0] + 0.5) - 0.5
    y = lfilter(b, a, y) if before else y
    y += noise * step * np.random.default_rng(1).normal(size=count)
    setup = Setup(PlantFamily(told, uncertainty), step, Parameters().estimator.bounds, 10.0, 0.3,
                  0.0, np.zeros(3))
    return setup, Window(0, v, step * np.round(y / step), np.full(len(v), np.nan))


@pytest.mark.parametrize('uncertainty', [0.2, 0.01])
def test_no_error_of_G_imitates_a_gap_behind_it(uncertainty: float) -> None:
    setup, record = moved_by(two_poles(0.3, 0.8), two_poles(0.3, 0.8), uncertainty, before=False)
    fit = afresh(setup, record)
    assert fit is not None
    assert fit.wiener
    assert np.abs(fit.xi).max() < 0.5
    assert setup.is_known(fit)
    assert abs(fit.gap - 1.0) < min(0.03, fit.gap_std)


@pytest.mark.parametrize('off', [0.8, 0.9, 1.1, 1.25])
def test_a_gap_behind_a_G_that_is_off_is_known_as_well_as_its_deviation_says(off: float) -> None:
    setup, record = moved_by(two_poles(0.2, 0.8), two_poles(0.2 * off, 0.8), 0.2, before=False)
    fit = afresh(setup, record)
    assert fit is not None
    assert fit.wiener
    assert setup.is_known(fit)
    assert abs(fit.gap - 1.0) < 3.0 * fit.gap_std < 0.05


@pytest.mark.parametrize('wiener', [False, True])
def test_derivatives_by_all_unknowns_are_exact(wiener: bool) -> None:
    setup, record = moved_by(two_poles(0.3, 0.8), two_poles(0.28, 0.7), 0.2, before=not wiener)
    problem, fit = setup.problem(record), afresh(setup, record)
    assert fit is not None
    assert fit.wiener is wiener
    fit, h = replace(fit, x=fit.x + 0.01, theta=fit.theta + 0.1, step=0.0), 1e-6
    changes = [{'x': fit.x + h * unit} for unit in np.eye(len(fit.x))]
    changes += [{'p0': fit.p0 + h}, *({'theta': fit.theta + h * unit} for unit in np.eye(7))]
    y, derivatives = problem.at(fit).y, problem.jacobian(fit).T
    for change, derivative in zip(changes, derivatives, strict=True):
        moved = (problem.at(replace(fit, **change)).y - y) / h
        np.testing.assert_allclose(derivative, moved, atol=1e-4 * np.abs(moved).max() + 1e-6)


@pytest.mark.parametrize('uncertainty', [0.2, 0.01])
def test_a_gap_before_a_G_that_is_far_off_is_known_however_exact_it_was_told(
    uncertainty: float,
) -> None:
    setup, record = moved_by(two_poles(0.13), two_poles(0.1), uncertainty, before=True)
    fit = afresh(setup, record)
    assert fit is not None
    assert setup.is_known(fit)
    assert abs(fit.gap - 1.0) < 0.05


def beliefs(setup: Setup, record: Window, begin: Belief) -> list[Belief]:
    found = [begin]
    for end in range(600, len(record.v), 100):
        found.append(learn(setup, record.between(found[-1].kept.first, end), found[-1]))
    return found[1:]


@pytest.mark.parametrize(('off', 'refuted'), [(1.05, True), (1.3, False)])
def test_a_G_that_its_prior_excludes_refutes_nothing_known_before(
    off: float, refuted: bool,
) -> None:
    known = Known(np.array([1.0, 0.6, -0.6]), np.diag([1e-3, 2e-3, 2e-3]) ** 2)
    setup, record = moved_by(
        two_poles(0.13), two_poles(0.13 / off), 0.01, before=True, count=1800)
    last = beliefs(setup, record, Belief(inherited=known, published=known))[-1]
    assert last.fit is not None
    assert abs(last.fit.gap - 1.0) < 0.05
    assert last.reason is (Status.TRACKING if refuted else Status.INCONSISTENT)
    assert (last.published is known) is not refuted


@pytest.mark.parametrize('steps', [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8])
def test_noise_of_any_share_of_an_encoder_step_is_found_and_contradicts_nothing(
    steps: float,
) -> None:
    servo = two_poles(0.13)
    setup, record = moved_by(servo, servo, 0.2, before=True, count=1800, noise=steps)
    found = beliefs(setup, record, Belief())
    assert all(one.state is State.KNOWN for one in found[2:])
    last = found[-1].fit
    assert last is not None
    assert abs(last.gap - 1.0) < 3.0 * last.gap_std < 0.05
    assert last.noise == pytest.approx(0.01 * np.hypot(steps, 12.0**-0.5), rel=0.25)


def test_friction_and_compliance_are_allowed_for_after_an_event_that_spoils_the_record() -> None:
    servo = two_poles(0.3, 0.8)
    setup, record = moved_by(servo, servo, 0.01, before=False, count=1800)
    record.y[:300] += 3.0 * np.sin(0.9 * np.arange(300))
    belief = Belief()
    for end in (1500, 1600, 1700, 1790):
        belief = learn(setup, record.between(belief.kept.first, end), belief)
    assert belief.trusted
    assert belief.published is not None
    _, c_r, c_l = belief.published.crossings
    assert abs(c_r - c_l - 1.0) < 0.03
