"""`monitor` beside real controllers: on a terminal, over a pipe, its keys and its end."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isnan
from pathlib import Path

from drivers.paced_driver import PacedDriver, controller_and_driver
from ros_processes import DEADLINE_S, RosWorld, ros_world

MODULE = 'monitor'
COMMAND = [sys.executable, '-m', f'backlash_ros.nodes.{MODULE}']
ESCAPES = re.compile(r'\x1b\[[0-9;?]*[a-zA-Z]')
HOME, LEAVE_SCREEN = '\x1b[H', '\x1b[?1049l'
CTRL_C = '\x03'


class Screen:
    """A monitor on a terminal of 80 columns and 24 lines."""

    def __init__(self, world: RosWorld) -> None:
        self._master, self._slave = pty.openpty()
        fcntl.ioctl(self._slave, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
        os.set_blocking(self._master, False)
        self._before = termios.tcgetattr(self._slave)
        self.output = ''
        self.process = subprocess.Popen(
            COMMAND, stdin=self._slave, stdout=self._slave, stderr=self._slave,
            env={**world.environment, 'TERM': 'xterm-256color'}, start_new_session=True,
            # So that Ctrl-C is a signal.
            preexec_fn=lambda: fcntl.ioctl(self._slave, termios.TIOCSCTTY, 0),
        )

    def read(self) -> None:
        try:
            while part := os.read(self._master, 65536):
                self.output += part.decode(errors='replace')
        except BlockingIOError:
            pass

    def frame(self) -> str:
        self.read()
        pictures = self.output.split(HOME)
        return ESCAPES.sub('', pictures[-2]) if len(pictures) > 2 else ''

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def wait(self) -> int:
        code = self.process.wait(DEADLINE_S)
        self.read()
        return code

    @property
    def restored(self) -> bool:
        return termios.tcgetattr(self._slave) == self._before and LEAVE_SCREEN in self.output

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self._master)
        os.close(self._slave)


@contextmanager
def screen_of(world: RosWorld) -> Iterator[Screen]:
    screen = Screen(world)
    try:
        yield screen
    finally:
        screen.close()


def switched(driver: PacedDriver, key: str, value: str) -> Callable[[], bool]:
    return lambda: driver.text(key) == value


def test_controllers_are_shown_and_the_selected_one_obeys_the_keys(tmp_path: Path) -> None:
    saved = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world, screen_of(world) as screen:
        controller, driver = controller_and_driver(world, **{'estimates.file': str(saved)})
        driver.learn()
        driver.run_until(
            lambda: 'tracking' in screen.frame() and '±' in screen.frame(), 'the screen')
        for piece in ('/controller', 'excitation', 'latency', 'lost', 'learning', 'q quit'):
            assert piece in screen.frame(), piece
        assert re.search(r'm +1\.[23]\d* ± ', screen.frame())
        screen.press('f')
        driver.run_until(switched(driver, 'learning', 'False'), 'to hold the estimates')
        driver.run_until(lambda: 'estimates are held' in screen.frame(), 'the answer')
        # The key goes by the state that is shown, and diagnostics may come after the answer.
        driver.run_until(lambda: 'frozen' in screen.frame(), 'the state')
        screen.press('f')
        driver.run_until(switched(driver, 'learning', 'True'), 'to learn again')
        screen.press('c')
        driver.run_until(switched(driver, 'compensating', 'False'), 'to compensate no more')
        screen.press('s')
        driver.run_until(lambda: 'saved in' in screen.frame(), 'the answer')
        assert saved.exists()
        screen.press('r')
        driver.run_until(lambda: 'once more' in screen.frame(), 'the question')
        assert driver.error() < 0.1
        screen.press('r')
        driver.run_until(
            lambda: isnan(driver.estimates[-1].data[4]) and driver.error() > 0.1, 'the reset')
        pan = world.start('controller', None, '--ros-args', '-r', '__ns:=/pan')
        driver.run_until(
            lambda: all(name in screen.frame() for name in ('> /controller', ' /pan/controller')),
            'both')
        screen.press('\t')
        driver.run_until(lambda: '> /pan/controller' in screen.frame(), 'the other one')
        driver.run_until(lambda: 'no diagnostics yet' not in screen.frame(), 'its diagnostics')
        # Nothing is asked of a controller before its services are found.
        driver.run_until(lambda: screen.press('c') or 'the gap is' in pan.stderr, 'its answer')
        screen.press('q')
        assert screen.wait() == 0
        assert screen.restored
        assert 'Traceback' not in screen.output
        assert controller.stop() == 0


def test_it_waits_until_ctrl_c_and_prints_plain_lines_without_a_terminal(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world, screen_of(world) as screen:
        awaited = f'waiting for a controller in ROS_DOMAIN_ID={world.domain}'
        probe = world.probe()
        probe.wait_until(lambda: awaited in screen.frame(), awaited)
        # The threads of the middleware wake up for each message.
        tasks = Path(f'/proc/{screen.process.pid}/task')
        of_dds = [int(each.name) for each in tasks.iterdir()
                  if (each / 'comm').read_text().startswith('dds.')]
        classes = {os.sched_getscheduler(each) for each in (screen.process.pid, *of_dds)}
        assert of_dds
        assert classes == {os.SCHED_BATCH}
        screen.press(CTRL_C)
        assert screen.wait() == 0
        assert screen.restored
        assert 'Traceback' not in screen.output
        monitor = world.start(MODULE)
        world.probe().wait_until(lambda: 'waiting for a controller' in monitor.stdout, 'a line')
        _, driver = controller_and_driver(world)
        driver.learn()
        line = re.compile(
            r'^/controller: tracking; m 1\.\d+ ± \S+, c_r \S+ ± \S+, c_l -\S+ ± \S+; '
            r'excitation \S+, latency \S+ ms, lost \d+$', re.MULTILINE)
        driver.run_until(lambda: line.search(monitor.stdout), 'the line')
        assert '\x1b' not in monitor.stdout
        assert (monitor.stop(), monitor.stderr) == (0, '')
