"""check_driver beside a driver in another process: each fault is told, and only that one."""

import csv
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from drivers.made_up_driver import LIMITS, PERIOD_S, parameters
from places import ROOT
from ros_processes import ForkedNode, Probe
from std_msgs.msg import Float64
from waiting import DEADLINE_S, wait_until

from backlash_ros.tools.bringup.environment import child_environment, free_domain

HERE = ROOT / 'test'
DURATION_S = 6.0
# A busy machine may hold the driver up, and then the check is right to find fault with this.
OF_THE_MACHINE = {'jitter', 'lost samples'}
REMAP = ['--ros-args', '-r', 'plant_output:=/motor/plant_output']


class Check(ForkedNode):
    """A check_driver, and what it prints."""

    def __init__(self, folder: Path, options: list[str], environment: dict[str, str]) -> None:
        number = len(list(folder.glob('*.out')))
        self._files = [folder / f'{number}.{kind}' for kind in ('out', 'err')]
        super().__init__('check_driver', options, *self._files, environment)

    @property
    def stdout(self) -> str:
        return self._files[0].read_text() if self._files[0].exists() else ''

    def communicate(self) -> tuple[str, str]:
        self.wait(DEADLINE_S)
        return self.stdout, self._files[1].read_text()


class Bench:
    """A domain with a driver in it, and check_driver to be run beside it."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder, self.domain = folder, domain
        self.environment = child_environment(folder, domain)
        self.driver: subprocess.Popen[bytes] | None = None
        self.config = folder / 'driver.yaml'
        # JSON is YAML.
        self.config.write_text(json.dumps({'/**': {'ros__parameters': parameters()}}))

    def start(self, *options: str) -> Check:
        """Start check_driver with the parameters of the plant."""
        return Check(self.folder, [
            '--config', str(self.config), '--duration', str(DURATION_S), *options,
        ], self.environment)

    def check(self, *options: str) -> tuple[int | None, str]:
        """Run check_driver; return its exit code and what it printed."""
        process = self.start(*options)
        try:
            out, err = process.communicate()
        finally:
            process.kill()
        return process.returncode, out + err


@contextmanager
def bench(folder: Path, fault: str = '') -> Iterator[Bench]:
    """A bench with a driver of this fault, or with none."""
    with free_domain() as domain:
        beside = Bench(folder, domain)
        if fault:
            beside.driver = subprocess.Popen(
                [sys.executable, str(HERE / 'drivers' / 'faulty_driver.py'), *fault.split()],
                env=beside.environment, stdin=subprocess.DEVNULL,
            )
        try:
            yield beside
        finally:
            if beside.driver is not None:
                beside.driver.kill()
                beside.driver.wait()


def subjects(told: str, mark: str) -> list[str]:
    """What the lines with this mark are about."""
    return [
        line[2:].split('  ')[0].strip() for line in told.splitlines() if line.startswith(mark)
    ]


# test_driver_judgement.py has what follows from the graph; here it has to be seen through ROS.
def test_what_is_wrong_in_the_graph_is_seen_and_nothing_is_judged_of_a_mixture(tmp_path):
    with bench(tmp_path, 'second best_effort') as beside:
        process = beside.start('--wait', str(DEADLINE_S), '--duration', '1')
        try:
            # The driver publishes below /motor.
            wait_until(lambda: ' '.join(REMAP) in process.stdout, 'a hint')
        finally:
            process.kill()
        code, told = beside.check('--duration', '1', *REMAP)
    assert code == 1
    assert {'publisher', 'QoS'} <= set(subjects(told, '✗'))
    assert {'rate', 'values', 'backlash'} <= set(subjects(told, '–'))


def test_a_drive_goes_on_from_the_v_that_acts_and_ends_at_rest_or_at_once(tmp_path: Path) -> None:
    with bench(tmp_path, 'none') as beside:
        probe = Probe(beside.domain)
        try:
            controls = probe.collect('control', Float64)
            first = beside.start('--drive', '--duration', '60')
            try:
                probe.wait_until(lambda: any(abs(c.data) > 2.0 for c in controls), 'a motion of v')
                first.send_signal(signal.SIGINT)
                probe.wait_until(lambda: first.poll() is not None, 'the end')
                out, err = first.communicate()
            finally:
                first.kill()
            probe.wait_until(lambda: controls[-1].data == 0.0, 'v at rest')
            assert 'Traceback' not in err
            assert err.count('nobody says which v acts now') == 1
            assert 'rate' in out
            assert_within_rate(0.0, controls, LIMITS.rate)
            begin = len(controls)
            again = beside.start(
                '--drive', '--rate', '0.5', '--ros-args', '-p', 'control.initial:=-4.0'
            )
            try:
                probe.wait_until(lambda: len(controls) > begin + 5, 'a motion')
                again.send_signal(signal.SIGINT)
                count = len(controls)
                probe.wait_until(lambda: len(controls) > count + 10, 'the way to rest, 8 s long')
                again.send_signal(signal.SIGINT)
                probe.wait_until(lambda: again.poll() is not None, 'the end')
                err = again.communicate()[1]
            finally:
                again.kill()
        finally:
            probe.close()
    assert_within_rate(-4.0, controls[begin:], 0.5)
    assert re.search(r'v is held at -[0-3]\..*another signal', err)
    assert 'nobody says' not in err


def assert_within_rate(start: float, controls: list[Float64], rate: float) -> None:
    v = [start, *(control.data for control in controls)]
    assert max(abs(b - a) for a, b in pairwise(v)) <= rate * PERIOD_S * (1.0 + 1e-9)


def test_a_good_driver_passes_and_what_cannot_be_driven_is_refused_or_ended(tmp_path):
    with bench(tmp_path, 'none') as beside:
        code, told = beside.check('--drive', '--save', str(tmp_path / 'record.csv'))
        wrong = set(subjects(told, '✗'))
        assert wrong <= OF_THE_MACHINE, told
        assert code == (1 if wrong else 0)
        assert {'sign and units', 'G(z)', 'backlash'} <= set(subjects(told, '✓'))
        with (tmp_path / 'record.csv').open(newline='') as file:
            rows = list(csv.DictReader(file))
        assert len(rows) > 50
        assert max(abs(float(row['v'])) for row in rows) <= LIMITS.high
        code, told = beside.check('--drive', '--output-range', '-0.5', '0.5', '--duration', '30')
        assert code == 1
        assert 'left --output-range' in told
        probe = Probe(beside.domain)
        try:
            probe.publisher('control', Float64)
            code, told = beside.check('--drive')
        finally:
            probe.close()
        assert code == 2
        assert '/control is published by ' in told
        for options, word in (
            (['--drive', '--ros-args', '-p', 'control.rate_max:=.inf'], 'give --rate'),
            (['--ros-args', '-p', 'sample_priod:=0.1'], 'did you mean sample_period?'),
            (['--config', 'nowhere.yaml'], 'nowhere.yaml'),
        ):
            code, told = beside.check(*options)
            assert code == 2
            assert word in told
            assert len(told.splitlines()) == 1
