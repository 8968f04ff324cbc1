"""The first command goes on from the v that acts already, whoever tells of it."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from drivers.paced_driver import NOISE, PacedDriver
from ros_processes import NodeProcess, RosWorld, ros_world
from test_lifecycle import Asked, Transition

STANDING = 5.13  # v at which the driver is found
RATE_MAX, PERIOD_S = 40.0, 0.01
STEP = RATE_MAX * PERIOD_S * (1.0 + 1e-9)
LIMITED = {'control.rate_max': RATE_MAX, 'estimator.output_noise_std': NOISE}
NOT_KNOWN = 'nobody says which v acts now'


def standing_driver(world: RosWorld, reports_applied: bool = False) -> PacedDriver:
    """A driver that holds v somewhere else than at 0."""
    driver = PacedDriver(world.probe(), reports_applied=reports_applied)
    driver.v = STANDING
    driver.run(0.1)
    return driver


def controller_beside(
    driver: PacedDriver, world: RosWorld, **parameters: object,
) -> NodeProcess:
    """A controller that meets a driver which does not wait for it, after a number of commands."""
    count = len(driver.controls)
    controller = world.start('controller', {**LIMITED, **parameters})
    driver.run_until(lambda: len(driver.controls) > count + 20, 'commands')
    return controller


def largest_step(driver: PacedDriver) -> float:
    commands = [STANDING, *(message.data for message in driver.controls)]
    return max(abs(b - a) for a, b in pairwise(commands))


@pytest.mark.parametrize('use_applied', [False, True])
def test_it_goes_on_from_what_the_driver_reports(tmp_path: Path, use_applied: bool) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world, reports_applied=True)
        controller = controller_beside(
            driver, world,
            **{'estimator.use_applied_control': use_applied, 'control.initial': -3.0},
        )
        assert largest_step(driver) <= STEP
        assert controller.stop() == 0
        assert NOT_KNOWN not in controller.stderr


def test_it_goes_on_from_control_initial_where_the_driver_reports_nothing(
    tmp_path: Path,
) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world)
        controller = controller_beside(driver, world, **{'control.initial': STANDING})
        assert largest_step(driver) <= STEP
        assert controller.stop() == 0
        assert NOT_KNOWN not in controller.stderr


def test_where_nobody_knows_v_it_is_said_once_and_0_is_taken(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world)
        controller = controller_beside(driver, world)
        assert abs(driver.controls[0].data) <= STEP
        asked = Asked(driver)
        assert asked.change(Transition.TRANSITION_DEACTIVATE)
        assert asked.change(Transition.TRANSITION_ACTIVATE)
        count = len(driver.controls)
        driver.run_until(lambda: len(driver.controls) > count + 20, 'commands')
        assert controller.stop() == 0
        assert controller.stderr.count(NOT_KNOWN) == 1
        assert 'control.initial' in controller.stderr


@pytest.mark.parametrize('steps', [
    (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE),
    (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
     Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE),
], ids=['deactivated', 'cleaned up'])
def test_a_controller_that_was_active_before_goes_on_from_its_last_command(
    tmp_path: Path, steps: tuple[int, ...],
) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world)
        controller = controller_beside(driver, world, **{'control.initial': STANDING})
        driver.run_until(lambda: abs(driver.controls[-1].data - STANDING) > 5.0, 'a way')
        asked = Asked(driver)
        for step in steps:
            assert asked.change(step)
        count = len(driver.controls)
        driver.run_until(lambda: len(driver.controls) > count + 20, 'commands')
        assert largest_step(driver) <= STEP
        assert controller.stop() == 0


def test_a_killed_controller_that_is_restarted_makes_no_jump(tmp_path: Path) -> None:
    keep = {'estimates.file': str(tmp_path / 'e.json'), 'estimates.load': True,
            'estimates.save_period': 0.1, 'estimator.law': 'kalman'}
    with ros_world(tmp_path) as world:
        driver = standing_driver(world, reports_applied=True)
        controller = controller_beside(driver, world, **keep)
        driver.run_until(lambda: abs(driver.controls[-1].data - STANDING) > 5.0, 'a way')
        controller.kill()
        driver.run(0.1)
        again = controller_beside(driver, world, **keep)
        assert largest_step(driver) <= STEP
        assert again.stop() == 0


def test_a_report_of_long_ago_is_not_where_a_silent_driver_is_found(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world, reports_applied=True)
        controller = controller_beside(driver, world, **{'timeout.plant_output': 0.2})
        driver.run_until(lambda: abs(driver.controls[-1].data - STANDING) > 5.0, 'a way')
        applied, driver.applied = driver.applied, None
        driver.sent = lambda k, y: []
        driver.run_until(lambda: driver.says('no plant_output'), 'a word about the silence')
        driver.sent = lambda k, y: [y]
        count = len(driver.controls)
        driver.run_until(lambda: len(driver.controls) > count + 20, 'commands')
        assert largest_step(driver) <= STEP
        assert applied is not None
        assert controller.stop() == 0


def test_the_simulated_plant_is_known_to_begin_at_0(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {**LIMITED})
        world.start('plant', {'output_noise_std': NOISE})
        world.start('reference')
        watch = PacedDriver(world.probe())  # only listens
        watch.probe.wait_until(lambda: len(watch.controls) > 20, 'commands')
        assert controller.stop() == 0
        assert NOT_KNOWN not in controller.stderr
        assert 'not set' not in controller.stderr


def test_missing_limits_are_told_once_beside_a_driver(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world, reports_applied=True)
        controller = controller_beside(driver, world, **{'control.min': -20.0})
        driver.run_until(lambda: len(driver.controls) > 60, 'commands')
        assert controller.stop() == 0
        assert controller.stderr.count('control.max: not set, so nothing keeps v') == 1


def test_where_all_limits_are_set_nothing_is_said(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        driver = standing_driver(world, reports_applied=True)
        controller = controller_beside(
            driver, world, **{'control.min': -20.0, 'control.max': 20.0}
        )
        assert controller.stop() == 0
        assert 'not set' not in controller.stderr
