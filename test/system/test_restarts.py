"""Processes that die, restart, are reconfigured or stopped while the loop runs."""

from __future__ import annotations

import json
import signal
import subprocess
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from drivers.paced_driver import NOISE, TRUTH, PacedDriver, controller_and_driver
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_processes import NodeProcess, ros_world, wait_until
from rosgraph_msgs.msg import Clock
from test_lifecycle import Asked

from backlash_ros import topics

PLANT = {'output_noise_std': NOISE}


def test_killed_driver_comes_back_and_the_estimates_are_kept(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {
            'estimator.output_noise_std': NOISE, 'timeout.plant_output': 0.3,
        })
        world.start('reference')
        first = world.start('plant', PLANT)
        watch = PacedDriver(world.probe())  # only listens

        def listen() -> None:
            watch.probe.spin(0.02)

        wait_until(lambda: watch.error() < 0.005, 'the estimates', listen)
        first.kill()
        wait_until(lambda: watch.says('no plant_output'), 'a word about the silence', listen)
        rows = len(watch.estimates)
        world.start('plant', {**PLANT, 'seed': 5, 'backlash.initial_u': 1.0})
        # A new driver may send y some time before it hears v.
        wait_until(lambda: len(watch.estimates) > rows + 100, 'the loop', listen)
        wait_until(lambda: watch.error() < 0.005, 'the estimates once more', listen)
        for row in watch.estimates[rows:]:
            assert abs(row.data[0] / 1.3 - 1.0) < 0.02
            assert abs(row.data[1] / 3.0 - 1.0) < 0.05
        wait_until(lambda: watch.value('interruptions') >= 1, 'the count', listen)
        assert controller.stop() == 0


def test_killed_controller_goes_on_with_the_saved_estimates(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    keep = {'estimates.file': str(file), 'estimates.load': True, 'estimates.save_period': 0.2,
            'estimator.output_noise_std': NOISE}
    with ros_world(tmp_path) as world:
        controller = world.start('controller', keep)
        driver = PacedDriver(world.probe())
        driver.meet(controller)
        driver.learn()
        driver.run_until(lambda: saved_error(file) < 0.02, 'saved estimates within 2 %')
        controller.kill()
        driver.run(0.2)  # what the killed one had still said
        rows = len(driver.estimates)
        again = world.start('controller', keep)
        driver.run_until(
            lambda: len(driver.estimates) > rows and again.events('ready'), 'the first new row'
        )
        saved = json.loads(file.read_text())['estimate']
        m, c_r, c_l = driver.estimates[rows].data[:3]
        assert (m, c_r, c_l) == pytest.approx((1.3, 3.0, -3.0), rel=0.05)
        assert set(saved) >= {'m', 'c_r', 'c_l', 'std_m'}
        driver.run(0.5)
        for row in driver.estimates[rows:]:
            assert abs(row.data[0] / 1.3 - 1.0) < 0.05
        assert again.stop() == 0
        assert 'going on with the estimates' in again.stderr


def saved_error(file: Path) -> float:
    """The largest relative error of the estimates in a file, 1 where there is none."""
    if not file.exists():
        return 1.0
    saved = json.loads(file.read_text())['estimate']
    return max(abs(saved[name] / true - 1.0) for name, true in TRUTH.items())


def test_saved_estimates_of_another_plant_are_refused(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{'estimates.file': str(file)})
        driver.learn()
        assert controller.stop() == 0
        other = world.start('controller', {
            'estimates.file': str(file), 'estimates.load': True, 'sample_period': 0.02,
        })
        assert other.wait() == 2
        assert 'was learned with sample_period=0.01, which is now 0.02' in other.stderr
        assert other.stderr.count('\n') == 1


@pytest.mark.parametrize('jump_s', [-3600, 3600])
def test_clock_jump_on_simulated_time_is_an_interruption_not_the_end(
    tmp_path: Path, jump_s: int,
) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {
            'estimator.output_noise_std': NOISE, 'use_sim_time': True,
        })
        probe = world.probe()
        clock = probe.publisher(topics.CLOCK, Clock)
        driver = PacedDriver(probe)
        offset = 10_000

        def with_clock(k: int, y: float) -> list[float]:
            stamp = (k + 1) * 10_000_000 + offset * 10**9
            clock.publish(Clock(clock=Time(sec=stamp // 10**9, nanosec=stamp % 10**9)))
            return [y]

        driver.sent = with_clock
        driver.meet(controller)
        driver.learn()
        commands = len(driver.controls)
        offset += jump_s
        driver.run_until(lambda: len(driver.controls) > commands + 100, 'further commands')
        driver.run_until_known(0.05)
        driver.check_sanity()
        assert controller.stop() == 0


def test_reconfiguration_under_load_keeps_the_loop_and_the_estimates(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        client = driver.probe.node.create_client(SetParameters, 'controller/set_parameters')
        driver.run_until(client.service_is_ready, 'the parameter service')
        for k in range(20):
            request = SetParameters.Request(parameters=[
                Parameter('estimator.output_noise_std', value=NOISE * (1.0 + 0.01 * k))
                .to_parameter_msg(),
                Parameter('control.max', value=50.0 + k).to_parameter_msg(),
                Parameter('inverse.direction_band', value=1e-9 * k).to_parameter_msg(),
            ])
            answer = client.call_async(request)
            driver.run_until(answer.done, 'the answer')
            assert all(result.successful for result in answer.result().results)
            driver.run(0.05)
        driver.run_until_known(0.02)
        driver.check_sanity()
        assert controller.stop() == 0


@pytest.mark.parametrize(('action', 'number'), [
    ('hold', signal.SIGINT), ('zero', signal.SIGTERM), ('ramp', signal.SIGINT),
    ('ramp', signal.SIGTERM),
])
def test_a_signal_ends_the_loop_with_the_configured_command(
    tmp_path: Path, action: str, number: signal.Signals,
) -> None:
    rate_max = 400.0
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            # On a machine under load the outputs, which pace the last commands, come late.
            world, **{'on_stop': action, 'control.rate_max': rate_max, 'timeout.ramp': 30.0}
        )
        driver.learn()
        driver.run_until(lambda: abs(driver.v) > 5.0, 'a v away from 0')
        controller.send(number)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        if action != 'hold':
            driver.run_until(lambda: driver.controls[-1].data == 0.0, 'v at 0')
        driver.run(0.1)
        assert controller.process.returncode == 0
        last = [message.data for message in driver.controls[-3:]]
        assert (last[-1] == 0.0) == (action != 'hold')
        if action == 'ramp':
            assert abs(last[-1] - last[-2]) <= rate_max * 0.01 * (1.0 + 1e-9)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_start_up_ends_the_process_with_code_0(
    tmp_path: Path, number: signal.Signals,
) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False
        for i in range(4):
            node = world.start('controller')
            # Before the interpreter has come to this package, nothing can be done about it;
            # SIGINT it catches by itself.
            wait_until(
                lambda node=node: _catches(node, signal.SIGTERM), 'a handler', lambda: None
            )
            with suppress(subprocess.TimeoutExpired):
                node.process.wait(0.25 * i)
            assert node.stop(number) == 0, node.stderr


def _catches(node: NodeProcess, number: signal.Signals) -> bool:
    status = Path(f'/proc/{node.process.pid}/status').read_text()
    caught = next(line for line in status.splitlines() if line.startswith('SigCgt'))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def test_no_sample_number_is_used_twice_whoever_is_restarted(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        # They are never sent, so that the count is ahead of the numbers of the driver.
        driver.sent = lambda k, y: [] if k % 3 == 0 else [y]
        asked = Asked(driver)
        driver.run(1.0)
        for transition in (
            Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
            Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE,
        ):
            assert asked.change(transition)
        rows = len(driver.signals)
        driver.run_until(lambda: len(driver.signals) > rows + 20, 'the loop after a cleanup')
        controller.kill()
        rows = len(driver.signals)
        again = world.start('controller', {'estimator.output_noise_std': NOISE})
        driver.run_until(lambda: len(driver.signals) > rows + 20, 'the second controller')
        assert again.stop() == 0
    column = topics.SIGNAL_LABELS.index('sample')
    samples = [row.data[column] for row in driver.signals]
    assert all(later > earlier for earlier, later in pairwise(samples))
