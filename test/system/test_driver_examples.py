"""The example drivers beside real nodes, and the commands that docs/driver.md prints."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from ros_processes import Probe, RosWorld, ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.tools.bringup.environment import child_environment, free_domain

EXAMPLES = ROOT / 'examples'
BLOCKS = re.findall(
    r'^```bash\n(.*?)^```', (ROOT / 'docs' / 'driver.md').read_text(), re.MULTILINE | re.DOTALL
)
# Beside these the commands that follow them are run.
FOREVER = ('motor_driver.py', 'bare_dds_driver.py', '/controller', '/reference')
SHORT = {'--duration': '2'}  # s; the pages give a user more time
DEADLINE_S = 90.0
# Of a driver that a machine under load holds up, a run says nothing.
HELD_UP, ATTEMPTS = ('✗ jitter', '✗ lost samples'), 5

# motor_driver.py with a motor that takes its time, and stands elsewhere than at 0.
SLOW_MOTOR = """
import motor_driver
class SlowMotor(motor_driver.SimulatedMotor):
    position, moved = 2.0, False
    def motor_encoder(self):
        return self.position
    def load_encoder(self):
        if self.moved:
            self.position += min(max(self._v - self.position, -0.02), 0.02)
        return super().load_encoder()
    def move_to(self, v):
        self.moved = True
        super().move_to(v)
motor_driver.motor = SlowMotor(motor_driver.SAMPLE_PERIOD_S)
motor_driver.main()
"""
PATHS = os.pathsep.join((str(EXAMPLES), str(ROOT)))


@contextmanager
def running(
    command: list[str], environment: dict[str, str], folder: Path = ROOT
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is ended with the context."""
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def final_estimates(world: RosWorld, driver: str) -> tuple[float, float, float]:
    """m, c_r, c_l that controller and reference come to with a driver, within 1 % of the paper."""
    probe = world.probe()
    heard = probe.collect(topics.ESTIMATES, Float64MultiArray)
    world.start('reference')
    world.start('controller', {'estimator.use_applied_control': True})
    with running([sys.executable, str(EXAMPLES / driver)], world.environment):
        probe.wait_until(lambda: heard and within_one_percent(heard[-1]), 'estimates within 1 %')
    m, c_r, c_l = heard[-1].data[:3]
    return m, c_r, c_l


def within_one_percent(message: Float64MultiArray) -> bool:
    return bool(np.allclose(message.data[:3], (1.3, 3.0, -3.0), rtol=0.01, atol=0.0))


def test_a_bare_dds_program_is_a_driver(tmp_path: Path) -> None:
    pytest.importorskip('cyclonedds')
    with ros_world(tmp_path) as world:
        assert final_estimates(world, 'bare_dds_driver.py') == pytest.approx(
            (1.3, 3.0, -3.0), rel=0.01
        )


@pytest.mark.parametrize('driver', ['motor_driver.py', 'bare_dds_driver.py'])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_example_drivers_end_on_a_signal(
    tmp_path: Path, driver: str, number: signal.Signals
) -> None:
    if driver.startswith('bare'):
        pytest.importorskip('cyclonedds')
    with ros_world(tmp_path) as world:
        probe = world.probe()
        command = [sys.executable, str(EXAMPLES / driver)]
        with running(command, world.environment) as process:
            probe.wait_until(
                lambda: probe.node.count_publishers('plant_output') > 0, 'the driver'
            )
            process.send_signal(number)
            assert process.wait(DEADLINE_S) == 0


class MotorBench:
    """motor_driver.py, driven by the test and with a slow motor, on a domain of its own."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.stderr = folder / 'driver.stderr'
        self.probe = Probe(domain)
        self.applied = self.probe.collect(topics.APPLIED_CONTROL, Float64)
        self.control = self.probe.publisher(topics.CONTROL, Float64)
        script = folder / 'slow_motor.py'
        script.write_text(SLOW_MOTOR)
        with self.stderr.open('wb') as err:
            self.process = subprocess.Popen(
                [sys.executable, str(script)], stderr=err, stdin=subprocess.DEVNULL,
                env={**child_environment(folder, domain), 'PYTHONPATH': PATHS},
            )

    def command(self, v: float, samples: int) -> None:
        """Send v for so many samples."""
        for _ in range(samples):
            self.control.publish(Float64(data=v))
            count = len(self.applied)
            self.probe.wait_until(lambda count=count: len(self.applied) > count, 'a sample')

    def wait_samples(self, samples: int) -> None:
        count = len(self.applied)
        self.probe.wait_until(lambda: len(self.applied) > count + samples, 'samples')

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.probe.close()


def test_the_motor_is_stopped_where_no_control_comes_any_more(tmp_path: Path) -> None:
    with free_domain() as domain:
        bench = MotorBench(tmp_path, domain)
        try:
            bench.wait_samples(50)
            assert 'no control' not in bench.stderr.read_text()  # none has come that could end
            # What the motor has not said it has not applied: it stands at 2 from the start on.
            assert {message.data for message in bench.applied} == {2.0}
            bench.probe.wait_until(bench.control.get_subscription_count, 'the driver')
            bench.command(8.0, 40)
            moving = bench.applied[-1].data
            assert 2.0 < moving < 8.0
            bench.wait_samples(60)
            held = bench.applied[-1].data
            assert moving < held < 8.0
            bench.wait_samples(40)
            assert bench.applied[-1].data == held
            assert bench.stderr.read_text().count('no control: the motor is stopped') == 1
            bench.command(8.0, 40)
            assert bench.applied[-1].data > held
        finally:
            bench.close()


def commands_of_driver_page() -> list[list[str]]:
    """The words of every command, in the order of the page."""
    lines = [line for block in BLOCKS for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line)) and words[0] != 'export']


def runnable(words: list[str]) -> list[str]:
    """The command as it is run here: this interpreter, and less time."""
    program, *arguments = words
    name = program.removeprefix('.venv/bin/')
    modules = dict(
        re.findall(r"f'(\w+) = \{PACKAGE\}\.([\w.]+):main'", (ROOT / 'setup.py').read_text())
    )
    if name != 'identify':  # which needs its time
        for i, argument in enumerate(arguments[:-1]):
            arguments[i + 1] = SHORT.get(argument, arguments[i + 1])
    arguments = [a.replace('.venv/bin/python', sys.executable) for a in arguments]
    if name == 'python':
        return [sys.executable, *arguments]
    return [sys.executable, '-m', f'backlash_ros.{modules[name]}', *arguments]


def page_in_parts() -> list[list[list[str]]]:
    """Commands grouped: those that run forever, then what is run beside them."""
    parts: list[list[list[str]]] = [[]]
    ended = False
    for words in commands_of_driver_page():
        forever = any(mark in ' '.join(words) for mark in FOREVER) and '--driver' not in words
        if forever and ended:
            parts.append([])
        ended = not forever
        parts[-1].append(words)
    return parts


@pytest.mark.parametrize('part', page_in_parts(), ids=lambda part: part[0][-1])
def test_commands_of_the_driver_page_run(tmp_path: Path, part: list[list[str]]) -> None:
    if any('bare_dds' in ' '.join(words) for words in part):
        pytest.importorskip('cyclonedds')
    for name in ('examples', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    with free_domain() as domain:
        environment = child_environment(tmp_path, domain)
        started: list[subprocess.Popen[bytes]] = []
        try:
            for words in part:
                run_or_start(words, environment, tmp_path, started)
            assert all(process.poll() is None for process in started)
        finally:
            for process in started:
                process.kill()
                process.wait()


def run_or_start(
    words: list[str], environment: dict[str, str], folder: Path,
    started: list[subprocess.Popen[bytes]],
) -> None:
    """Start what runs forever; run the rest, which has to do what it is for."""
    text = ' '.join(words)
    if any(mark in text for mark in FOREVER) and '--driver' not in words:
        started.append(subprocess.Popen(
            runnable(words), cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        ))
        return
    if '--driver' in words:
        for process in started:
            process.kill()
            process.wait()
        started.clear()
    for _ in range(ATTEMPTS):
        done = subprocess.run(
            runnable(words), cwd=folder, env=environment, capture_output=True, text=True,
            timeout=DEADLINE_S,
        )
        if does_what_it_is_for(done) or not any(word in done.stdout for word in HELD_UP):
            break
    assert does_what_it_is_for(done), done.stdout + done.stderr


def does_what_it_is_for(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether a command has ended well; check_driver may find fault with the timing alone."""
    if any('check_driver' in word for word in done.args):
        fits = ('✓ sign and units', '✓ G(z)')
        return done.returncode in (0, 1) and all(line in done.stdout for line in fits)
    return bool(done.returncode == 0)
