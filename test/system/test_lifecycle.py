"""The controller as a managed node, and what it does when it is asked."""

from __future__ import annotations

import json
import os
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from drivers.paced_driver import PacedDriver, controller_and_driver
from fuzzing import node_with
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from ros_processes import RosWorld, ros_world
from std_srvs.srv import SetBool, Trigger

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.tools.bringup.environment import free_domain

RATE_MAX = 400.0
STEP = RATE_MAX * 0.01 * (1.0 + 1e-9)


class Asked:
    """Calls services of the controller while the loop goes on."""

    def __init__(self, driver: PacedDriver) -> None:
        self._driver = driver

    def __call__(self, service: str, kind: type[Any], request: Any) -> Any:
        driver = self._driver
        client = driver.probe.node.create_client(kind, f'controller/{service}')
        driver.run_until(client.service_is_ready, service)
        answer = client.call_async(request)
        driver.run_until(answer.done, f'an answer of {service}')
        return answer.result()

    def change(self, transition: int) -> bool:
        """Whether a transition succeeded."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self('change_state', ChangeState, request).success)

    def state(self) -> str:
        """The present state."""
        return str(self('get_state', GetState, GetState.Request()).current_state.label)

    def set(self, service: str, value: bool) -> bool:
        """Whether a SetBool service succeeded."""
        return bool(self(service, SetBool, SetBool.Request(data=value)).success)

    def trigger(self, service: str) -> Any:
        """Response of a Trigger service."""
        return self(service, Trigger, Trigger.Request())


def test_controller_goes_through_its_life_and_publishes_only_while_active(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'autostart': False})
        driver = PacedDriver(world.probe())
        asked = Asked(driver)
        assert asked.state() == 'unconfigured'
        assert not asked.set('freeze_adaptation', True)
        assert asked.change(Transition.TRANSITION_CONFIGURE)
        driver.run(0.3)
        assert asked.state() == 'inactive'
        assert driver.controls == []
        assert asked.change(Transition.TRANSITION_ACTIVATE)
        driver.run_until(lambda: len(driver.controls) > 50, 'controls')
        assert not asked.change(Transition.TRANSITION_CONFIGURE)  # does not fit, harms nobody
        assert asked.change(Transition.TRANSITION_DEACTIVATE)
        driver.run(0.2)
        count = len(driver.controls)
        driver.run(0.3)
        assert len(driver.controls) == count
        assert asked.change(Transition.TRANSITION_CLEANUP)
        assert asked.state() == 'unconfigured'
        assert asked.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
        assert asked.state() == 'finalized'
        assert controller.stop() == 0


def test_a_node_whose_activation_fails_is_not_active(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise ParameterError('sample_period', 0.0, 'does not suit this test')

    with free_domain() as domain, node_with({'autostart': False}, domain) as node:
        untyped: Any = node
        untyped.trigger_configure()
        monkeypatch.setattr(node, 'activate', fail)
        untyped.trigger_activate()
        assert not node.active
        monkeypatch.undo()
        untyped.trigger_activate()
        assert node.active


@pytest.mark.parametrize('structure', ['proportional', 'tracking'])
def test_reactivation_keeps_the_estimates_and_makes_no_jump(
    tmp_path: Path, structure: str,
) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, structure=structure, **{
                'control.rate_max': RATE_MAX, 'on_stop': 'ramp',
                'timeout.ramp': 30.0,  # a loop that is held up may be far from 0
            },
        )
        asked = Asked(driver)
        driver.learn()
        assert asked.change(Transition.TRANSITION_DEACTIVATE)
        driver.run_until(lambda: driver.controls[-1].data == 0.0, 'v at 0')
        assert asked.change(Transition.TRANSITION_ACTIVATE)
        rows = len(driver.estimates)
        driver.run_until(lambda: len(driver.estimates) > rows + 50, 'the loop')
        for row in driver.estimates[rows:]:
            assert abs(row.data[0] / 1.3 - 1.0) < 0.05
        commands = [message.data for message in driver.controls]
        assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
        assert controller.stop() == 0


def test_frozen_estimates_stay_and_learning_goes_on_afterwards(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        asked = Asked(driver)
        driver.learn()
        assert asked.set('freeze_adaptation', True)
        # The estimates of outputs that were under way are not held yet.
        driver.run(0.2)
        held = driver.estimate()
        driver.run(0.3)
        assert driver.estimate() == held
        driver.run_until(lambda: driver.text('state') == 'held', 'the state in words')
        assert asked.set('freeze_adaptation', False)
        driver.run_until(lambda: driver.estimate() != held, 'a change')
        driver.run_until_known(0.02)
        assert controller.stop() == 0


def test_without_compensation_v_no_longer_jumps_over_the_gap(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        asked = Asked(driver)
        driver.learn()
        gap = 5.0
        steps = [abs(b.data - a.data) for a, b in pairwise(driver.controls[-100:])]
        assert max(steps) > gap
        assert asked.set('enable_compensation', False)
        driver.run(0.1)
        count = len(driver.controls)
        driver.run(0.6)  # longer than a period of y_m
        steps = [abs(b.data - a.data) for a, b in pairwise(driver.controls[count:])]
        assert max(steps) < gap
        count = len(driver.controls)
        assert asked.set('enable_compensation', True)
        driver.run_until(
            lambda: any(
                abs(b.data - a.data) > gap for a, b in pairwise(driver.controls[count:])
            ), 'a jump over the gap',
        )
        driver.run_until_known(0.02)
        assert controller.stop() == 0


def test_reset_estimates_begins_with_the_first_guess(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        asked = Asked(driver)
        driver.learn()
        rows = len(driver.estimates)
        assert asked.trigger('reset_estimates').success
        driver.run_until(
            lambda: any(row.data[0] == 0.696 for row in driver.estimates[rows:]), 'the first guess'
        )
        driver.run_until_known(0.02)
        assert controller.stop() == 0


def test_estimates_are_saved_on_request_or_the_reason_is_told(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, **{'estimates.file': str(file), 'estimates.save_period': 0.0}
        )
        asked = Asked(driver)
        driver.learn()
        assert not file.exists()
        answer = asked.trigger('save_estimates')
        assert answer.success, answer.message
        assert json.loads(file.read_text())['estimate']['m'] == pytest.approx(1.3, rel=0.02)
        assert controller.stop() == 0
        nowhere, driver = another(world, str(tmp_path / 'missing' / 'estimates.json'))
        driver.run_until_known(0.02)
        answer = Asked(driver).trigger('save_estimates')
        assert not answer.success
        assert 'cannot be written: No such file or directory' in answer.message
        assert nowhere.stop() == 0


def test_saving_without_a_file_says_what_to_do(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        answer = Asked(driver).trigger('save_estimates')
        assert not answer.success
        assert 'start with -p estimates.file:=PATH, or set it while unconfigured' in answer.message
        assert controller.stop() == 0


# In front of the standard library: a disk that takes its time to confirm.
SLOW_DISK = """
import os, time
confirm = os.fsync
def slowly(file):
    time.sleep(1.0)
    confirm(file)
os.fsync = slowly
"""


def test_a_slow_disk_holds_up_the_answer_but_not_the_loop(tmp_path: Path) -> None:
    (tmp_path / 'sitecustomize.py').write_text(SLOW_DISK)
    with ros_world(tmp_path) as world:
        world.forked = False
        paths = [str(tmp_path), *filter(None, [world.environment.get('PYTHONPATH')])]
        world.environment['PYTHONPATH'] = os.pathsep.join(paths)
        controller, driver = another(world, str(tmp_path / 'estimates.json'))
        asked = Asked(driver)
        driver.learn()
        count = len(driver.controls)
        begin = time.monotonic()
        assert asked.trigger('save_estimates').success
        assert time.monotonic() - begin > 1.0
        assert len(driver.controls) - count > 50
        # Other requests are answered meanwhile.
        client = driver.probe.node.create_client(Trigger, 'controller/save_estimates')
        driver.run_until(client.service_is_ready, 'the service')
        saved = client.call_async(Trigger.Request())
        driver.run(0.1)
        assert asked.set('freeze_adaptation', True)
        assert not saved.done()
        driver.run_until(saved.done, 'the second answer')
        assert saved.result().success
        assert controller.stop() == 0


def test_noise_is_not_changed_live_for_a_law_that_would_not_take_it_up(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{'estimator.law': 'lms'})
        asked = Asked(driver)
        driver.run(0.1)
        request = SetParametersAtomically.Request(parameters=[
            Parameter('estimator.output_noise_std', value=2e-3).to_parameter_msg()
        ])
        kind = SetParametersAtomically
        refused = asked('set_parameters_atomically', kind, request).result
        assert not refused.successful
        assert 'estimator.output_noise_std=0.002' in refused.reason
        assert 'not taken up live by lms' in refused.reason
        # Whoever restarts takes it up.
        assert asked.change(Transition.TRANSITION_DEACTIVATE)
        assert asked.change(Transition.TRANSITION_CLEANUP)
        assert asked('set_parameters_atomically', kind, request).result.successful
        assert controller.stop() == 0


def another(world: RosWorld, file: str) -> tuple[Any, PacedDriver]:
    return controller_and_driver(world, **{'estimates.file': file, 'estimates.save_period': 0.0})


def test_live_parameters_change_together_or_not_at_all(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, structure='tracking', **{'control.min': -200.0, 'control.max': 200.0}
        )
        asked = Asked(driver)
        driver.learn()

        def change(**values: object) -> Any:
            request = SetParametersAtomically.Request(parameters=[
                Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
                for name, value in values.items()
            ])
            kind = SetParametersAtomically
            return asked('set_parameters_atomically', kind, request).result

        assert change(
            tracking__input_weight=0.02, estimator__output_noise_std=2e-3, on_stop='zero',
            timeout__plant_output=0.8, inverse__caution=2.0,
        ).successful
        refused = change(control__max=5.0, on_timeout='ramp')
        assert not refused.successful
        assert 'needs a finite control.rate_max' in refused.reason
        driver.run(0.5)
        assert max(message.data for message in driver.controls[-50:]) > 5.0
        refused = change(sample_period=0.02)
        assert not refused.successful
        driver.run_until_known(0.05)
        assert controller.stop() == 0


def test_all_but_the_interface_may_change_while_unconfigured(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'autostart': False, 'sample_period': 0.5})
        driver = PacedDriver(world.probe())
        asked = Asked(driver)

        def set_parameter(name: str, value: object) -> Any:
            request = SetParametersAtomically.Request(
                parameters=[Parameter(name, value=value).to_parameter_msg()]
            )
            return asked('set_parameters_atomically', SetParametersAtomically, request).result

        assert set_parameter('sample_period', 0.01).successful
        assert set_parameter('estimator.output_noise_std', 1e-3).successful
        assert set_parameter('estimator.initial.m', 1.0).successful
        assert set_parameter('estimates.file', str(file)).successful
        refused = set_parameter('estimator.initial.c_r', 1e9)
        assert 'must lie within' in refused.reason
        assert 'read-only' in set_parameter('io.style', 'ros2_control').reason
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert asked.change(transition)
        refused = set_parameter('sample_period', 0.02)
        assert not refused.successful
        assert 'is read-only while the node is configured: deactivate' in refused.reason
        driver.run_until(lambda: driver.estimates, 'estimates')
        assert driver.estimates[0].data[0] == 1.0
        driver.learn()
        assert asked.trigger('save_estimates').success
        assert file.exists()
        assert controller.stop() == 0
