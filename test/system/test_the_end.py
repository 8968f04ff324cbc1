"""What a signal leaves behind: v, estimates, a process that ends soon."""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path

import pytest
from drivers.paced_driver import controller_and_driver
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import ros_world
from waiting import wait_until


def test_a_ramp_longer_than_it_may_last_stops_where_it_is(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, **{'on_stop': 'ramp', 'control.rate_max': 20.0, 'timeout.ramp': 0.1}
        )
        driver.run_until(lambda: abs(driver.v) > 3.0, 'a v away from 0')
        controller.send(signal.SIGINT)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert abs(driver.controls[-1].data) > 0.1
        assert 'is held: it did not reach zero within timeout.ramp=0.1 s' in controller.stderr


def test_what_was_learned_is_saved_at_the_end(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, **{'estimates.file': str(file), 'estimates.save_period': 0.0}
        )
        driver.learn()
        assert not file.exists()
        controller.send(signal.SIGTERM)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert file.exists()


def test_estimates_are_saved_before_a_long_ramp_and_sigterm_ends_it(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{
            'estimates.file': str(file), 'estimates.save_period': 0.0, 'on_stop': 'ramp',
            'control.rate_max': 20.0, 'timeout.ramp': 3600.0,
        })
        driver.learn()
        driver.run_until(lambda: abs(driver.v) > 3.0, 'a v away from 0')
        # So that the ramp is not over before anybody has looked at it.
        client = AsyncParameterClient(driver.probe.node, 'controller')
        driver.run_until(client.services_are_ready, 'the parameters')
        slowed = client.set_parameters([Parameter('control.rate_max', value=0.01)])
        driver.run_until(slowed.done, 'a slower ramp')
        controller.send(signal.SIGINT)
        driver.run_until(file.exists, 'saved estimates')
        controller.send(signal.SIGINT)  # as a terminal and ros2 launch send it, both at once
        driver.run(0.3)
        assert controller.process.poll() is None
        controller.send(signal.SIGTERM)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert 'is held: SIGTERM came before it reached zero' in controller.stderr
        steps = [abs(b.data - a.data) for a, b in pairwise(driver.controls[-20:])]
        assert max(steps) < 0.011 * 0.01


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_that_come_until_the_very_end_do_no_harm(
    tmp_path: Path, number: signal.Signals,
) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False  # the end of the interpreter is part of it
        reference = world.start('reference')
        reference.wait_for('ready')
        wait_until(
            lambda: reference.send(number) or reference.process.poll() is not None, 'the end',
            lambda: None,
        )
        assert reference.process.returncode == 0
