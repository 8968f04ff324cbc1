"""check_driver beside a driver in another process: each fault is told, and only that one."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from drivers.made_up_driver import LIMITS, PERIOD_S, parameters
from places import ROOT
from ros_processes import ForkedNode, Probe
from std_msgs.msg import Float64
from waiting import DEADLINE_S, wait_until

from backlash_ros.nodes.check_driver import main
from backlash_ros.nodes.diagnostics.presence import LISTED, Presence
from backlash_ros.tools.bringup.environment import child_environment, free_domain

HERE = ROOT / 'test'
DURATION_S = 6.0
# A machine under load may hold the driver up: then the check is right to find fault with it, and
# a run that ends otherwise than it should says nothing.
HELD_UP, ATTEMPTS = 0.3, 5
REMAP = ['--ros-args', '-r', 'plant_output:=/motor/plant_output']


class Check(ForkedNode):
    """A check_driver, and what it prints."""

    def __init__(self, folder: Path, options: list[str], environment: dict[str, str]) -> None:
        number = len(list(folder.glob('*.out')))
        self._files = [folder / f'{number}.{kind}' for kind in ('out', 'err')]
        super().__init__('check_driver', options, *self._files, environment)

    @property
    def stdout(self) -> str:
        """What it has printed so far."""
        return self._files[0].read_text() if self._files[0].exists() else ''

    def communicate(self) -> tuple[str, str]:
        """All that it has printed and complained of, once it has ended."""
        self.wait(DEADLINE_S)
        return self.stdout, self._files[1].read_text()


class Bench:
    """A domain with a driver in it, and check_driver to be run beside it."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder, self.domain = folder, domain
        self.environment = child_environment(folder, domain)
        self.driver: subprocess.Popen[str] | None = None
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

    def held_up(self) -> float:
        """End the driver; return by which share of a period it was held up at most."""
        assert self.driver is not None
        self.driver.terminate()
        return float(self.driver.communicate(timeout=DEADLINE_S)[0])


@contextmanager
def bench(folder: Path, fault: str = '') -> Iterator[Bench]:
    """A bench with a driver of this fault, or with none."""
    with free_domain() as domain:
        beside = Bench(folder, domain)
        if fault:
            beside.driver = subprocess.Popen(
                [sys.executable, str(HERE / 'drivers' / 'faulty_driver.py'), fault], text=True,
                env=beside.environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            )
        try:
            yield beside
        finally:
            if beside.driver is not None:
                beside.driver.kill()
                beside.driver.communicate()


def subjects(told: str, mark: str) -> list[str]:
    """What the lines with this mark are about."""
    return [
        line[2:].split('  ')[0].strip() for line in told.splitlines() if line.startswith(mark)
    ]


def assert_told(folder: Path, fault: str, wrong: list[str], *options: str) -> str:
    """Run check_driver beside a driver: this and no more is wrong; return what it printed."""
    for _ in range(ATTEMPTS):
        with bench(folder, fault) as beside:
            code, told = beside.check(*options)
            if (subjects(told, '✗'), code) == (wrong, 1 if wrong else 0):
                return told
            assert beside.held_up() > HELD_UP, told
    raise AssertionError(f'the machine held up the driver in each of {ATTEMPTS} runs')


def test_a_good_driver_passes_and_its_record_is_saved(tmp_path: Path) -> None:
    assert_told(tmp_path, 'none', [], '--drive', '--save', str(tmp_path / 'record.csv'))
    with (tmp_path / 'record.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 50
    assert max(abs(float(row['v'])) for row in rows) <= LIMITS.high


def test_a_delay_is_told_though_the_topic_has_another_name(tmp_path: Path) -> None:
    told = assert_told(tmp_path, 'delay', ['reaction delay'], '--drive', *REMAP)
    assert 'set control.delay_samples: 2' in told


# test_driver_judgement.py has what follows from the graph; here it has to be seen through ROS.
def test_a_best_effort_driver_is_heard_and_told(tmp_path: Path) -> None:
    with bench(tmp_path, 'best_effort') as beside:
        code, told = beside.check('--duration', '2')
    assert code == 1
    assert 'QoS' in subjects(told, '✗')
    assert 'values' in subjects(told, '✓')


def test_a_second_driver_is_told_and_nothing_is_judged_of_the_mixture(tmp_path: Path) -> None:
    with bench(tmp_path, 'second') as beside:
        code, told = beside.check('--duration', '1')
    assert code == 1
    assert 'publisher' in subjects(told, '✗')
    assert {'rate', 'values', 'backlash'} <= set(subjects(told, '–'))


def test_listening_alone_does_not_move_v(tmp_path: Path) -> None:
    told = assert_told(tmp_path, 'none', ['backlash'], '--duration', '2')
    assert 'check_driver --drive' in told


def test_a_topic_of_another_name_is_pointed_out(tmp_path: Path) -> None:
    with bench(tmp_path, 'delay') as beside:
        process = beside.start('--wait', str(DEADLINE_S))
        try:
            wait_until(lambda: '/motor/plant_output' in process.stdout, 'a hint')
            assert ' '.join(REMAP) in process.stdout
        finally:
            process.kill()


def test_nobody_there_is_said(tmp_path: Path) -> None:
    with bench(tmp_path) as beside:
        code, told = beside.check('--wait', '0.1')
    assert code == 1
    assert 'waiting for /plant_output (std_msgs/msg/Float64)' in told
    assert 'sees no other topic' in told


def test_sigint_brings_v_to_rest(tmp_path: Path) -> None:
    with bench(tmp_path, 'none') as beside:
        probe = Probe(beside.domain)
        try:
            controls = probe.collect('control', Float64)
            process = beside.start('--drive', '--duration', '60')
            try:
                probe.wait_until(
                    lambda: any(abs(c.data) > 2.0 for c in controls), 'a motion of v'
                )
                process.send_signal(signal.SIGINT)
                probe.wait_until(lambda: process.poll() is not None, 'the end')
                out, err = process.communicate()
            finally:
                process.kill()
            probe.wait_until(lambda: controls[-1].data == 0.0, 'v at rest')
        finally:
            probe.close()
    assert 'Traceback' not in err
    assert 'rate' in out
    v = [c.data for c in controls]
    step = LIMITS.rate * parameters()['sample_period']
    assert max(abs(b - a) for a, b in pairwise(v)) <= step * (1.0 + 1e-9)


def way_to_rest(
    folder: Path, act: Callable[[Check, float], None], *options: str,
) -> tuple[float, str]:
    """Let v come to rest very slowly, and act; return how long the end took, and what was said."""
    slow = ('--rate', '0.5', '--ros-args', '-p', 'control.initial:=4.0')
    with bench(folder, 'none') as beside:
        probe = Probe(beside.domain)
        try:
            controls = probe.collect('control', Float64)
            process = beside.start('--drive', *options, *slow)
            try:
                probe.wait_until(lambda: len(controls) > 5, 'a motion')
                begin = time.monotonic()
                act(process, begin)
                probe.wait_until(lambda: process.poll() is not None, 'the end')
                took = time.monotonic() - begin
                err = process.communicate()[1]
            finally:
                process.kill()
        finally:
            probe.close()
    return took, err


def test_a_signal_on_the_way_to_rest_holds_v(tmp_path: Path) -> None:
    def interrupt_twice(process: Check, begin: float) -> None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
        assert process.poll() is None  # on its way, which takes 8 s
        process.send_signal(signal.SIGINT)

    took, err = way_to_rest(tmp_path, interrupt_twice)
    assert took < 4.0
    assert 'v is held at 3.' in err
    assert 'another signal' in err


def test_the_way_to_rest_has_a_deadline(tmp_path: Path) -> None:
    def interrupt(process: Check, begin: float) -> None:
        process.send_signal(signal.SIGINT)

    took, err = way_to_rest(tmp_path, interrupt, '--rest', '1')
    assert took < 5.0
    assert 'v is held at 3.' in err
    assert '--rest=1' in err


def first_commands(
    folder: Path, *options: str, reported: float | None = None,
) -> tuple[list[float], str]:
    """What a drive begins with, beside a driver that reports this v, and what is printed."""
    with bench(folder, 'none') as beside:
        probe = Probe(beside.domain)
        try:
            controls = probe.collect('control', Float64)
            reports = probe.publisher('applied_control', Float64)

            def driven() -> bool:
                if reported is not None:
                    reports.publish(Float64(data=reported))
                return len(controls) > 20

            process = beside.start('--drive', '--duration', '60', *options)
            try:
                probe.wait_until(driven, 'commands')
                process.send_signal(signal.SIGINT)
                probe.wait_until(lambda: process.poll() is not None, 'the end')
                err = process.communicate()[1]
            finally:
                process.kill()
        finally:
            probe.close()
    return [message.data for message in controls], err


def test_the_drive_goes_on_from_control_initial(tmp_path: Path) -> None:
    v, err = first_commands(tmp_path, '--ros-args', '-p', 'control.initial:=-4.0')
    step = LIMITS.rate * PERIOD_S * (1.0 + 1e-9)
    assert max(abs(b - a) for a, b in pairwise([-4.0, *v])) <= step
    assert 'nobody says' not in err


def test_a_report_beyond_the_limits_leads_no_drive_out_of_them(tmp_path: Path) -> None:
    v, _ = first_commands(tmp_path, reported=4096.0)
    assert LIMITS.high - 2.0 * LIMITS.rate * PERIOD_S <= v[0] <= LIMITS.high


def test_the_drive_says_that_nobody_knows_v(tmp_path: Path) -> None:
    v, err = first_commands(tmp_path)
    assert abs(v[0]) <= LIMITS.rate * PERIOD_S
    assert err.count('nobody says which v acts now') == 1


def test_y_outside_the_given_range_ends_the_drive(tmp_path: Path) -> None:
    with bench(tmp_path, 'none') as beside:
        code, told = beside.check('--drive', '--output-range', '-0.5', '0.5', '--duration', '30')
    assert code == 1
    assert 'left --output-range' in told


def test_a_controller_that_drives_already_is_not_disturbed(tmp_path: Path) -> None:
    with bench(tmp_path, 'none') as beside:
        probe = Probe(beside.domain)
        try:
            probe.publisher('control', Float64)
            process = beside.start('--drive')
            probe.wait_until(lambda: process.poll() is not None, 'the refusal')
            err = process.communicate()[1]
        finally:
            probe.close()
    assert process.returncode == 2
    assert '/control is published by ' in err


@pytest.mark.skipif(not LISTED.exists(), reason='needs Linux')
def test_a_controller_that_discovery_has_not_found_is_not_disturbed(tmp_path: Path) -> None:
    with bench(tmp_path, 'none') as beside, \
            closing(Presence(beside.domain, '/control', 'f' * 32)) as hidden:
        process = beside.start('--drive')
        # Who comes after it knows of it likewise.
        wait_until(hidden.others, 'its presence')
        err = process.communicate()[1]
    assert process.returncode == 2
    assert '/control is published by a controller of this machine' in err


@pytest.mark.parametrize(('options', 'word'), [
    (['--amplitude', '3'], 'give --drive'),
    (['--duration', '-1'], 'must be finite and > 0'),
])
def test_bad_options_are_one_line_and_code_2(
    capsys: pytest.CaptureFixture[str], options: list[str], word: str
) -> None:
    with pytest.raises(SystemExit) as left:
        main(options)
    told = capsys.readouterr().err
    assert left.value.code == 2
    assert word in told
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize(('options', 'word'), [
    (['--drive', '--ros-args', '-p', 'control.rate_max:=.inf'], 'give --rate'),
    (['--ros-args', '-p', 'sample_priod:=0.1'], 'did you mean sample_period?'),
    (['--config', 'nowhere.yaml'], 'nowhere.yaml'),
])
def test_bad_input_is_one_line_and_code_2(
    tmp_path: Path, options: list[str], word: str
) -> None:
    with bench(tmp_path) as beside:
        code, told = beside.check(*options)
    assert code == 2
    assert word in told
    assert len(told.splitlines()) == 1


def test_neither_this_node_nor_the_command_line_counts_as_a_listener(tmp_path: Path) -> None:
    with bench(tmp_path) as beside:
        probe = Probe(beside.domain)
        watching = Probe(beside.domain, '_ros2cli_1')
        output = probe.publisher('plant_output', Float64)
        watching.collect('control', Float64)
        process = beside.start('--duration', '2', '--ros-args', '-r', '__node:=looker')
        try:
            while process.poll() is None:
                output.publish(Float64(data=1.0))
                probe.spin(0.04)
        finally:
            process.kill()
            watching.close()
            probe.close()
        told, _ = process.communicate()
    (line,) = [line for line in told.splitlines() if line[2:].startswith('listener  ')
               and line.startswith('✗')]
    assert line.split('  ', 1)[1].strip() == 'nobody listens to control'


def test_a_shipped_file_is_found_by_its_name(tmp_path: Path) -> None:
    with bench(tmp_path) as beside:
        code, told = beside.check('--config', 'geared_motor.yaml', '--wait', '0.1')
    assert code == 1, told
    assert 'nobody publishes plant_output' in told


def test_what_a_file_holds_for_the_controller_alone_counts(tmp_path: Path) -> None:
    with bench(tmp_path) as beside:
        own = {'/controller': {'ros__parameters': {'control': {'min': 'nothing'}}}}
        document = json.loads(beside.config.read_text())
        beside.config.write_text(json.dumps({**document, **own}))
        code, told = beside.check('--drive')
    assert code == 2
    assert "control.min='nothing'" in told


def test_help_names_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(['--help'])
    assert left.value.code == 0
    assert 'Exit codes' in capsys.readouterr().out
