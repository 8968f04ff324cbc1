"""bringup with several axes: nodes in namespaces, one fate, a result folder for each."""

from __future__ import annotations

import io
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from bringup_processes import Session, bag_counts

from backlash_ros.tools import bringup
from backlash_ros.tools.progress import ProgressDisplay

CONFIG = Path(__file__).resolve().parents[1] / 'config' / 'two_axes.yaml'
TRUTH = {'pan': (1.3, 3.0, -3.0), 'tilt': (0.8, 1.0, -2.0)}


def assert_learned(session: Session, axis: str) -> None:
    final = json.loads((session.out / axis / 'summary.json').read_text())['final']
    for name, truth in zip(('m', 'c_r', 'c_l'), TRUTH[axis], strict=True):
        assert final[name] == pytest.approx(truth, rel=0.01)


def test_each_axis_learns_its_own_backlash_in_a_time_of_its_own(
    start: Callable[..., Session],
) -> None:
    session = start(
        '--config', str(CONFIG), '--lockstep', '--duration', '2', '--seed', '4',
        '--set', 'bias=0.5', '--set', 'tilt/bias=0.25',
    )
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert sorted(path.name for path in session.out.iterdir()) == ['pan', 'tilt']
    for axis, bias in (('pan', 0.5), ('tilt', 0.25)):
        folder = session.out / axis
        summary = json.loads((folder / 'summary.json').read_text())
        assert (summary['samples'], summary['lost_samples']) == (200, 0)
        assert_learned(session, axis)
        assert bag_counts(folder / 'bag')[f'{axis}/plant_output'] == 200
        assert (folder / 'logs' / 'controller.log').is_file()
        effective = yaml.safe_load((folder / 'parameters.yaml').read_text())
        assert list(effective) == ['/**']
        assert effective['/**']['ros__parameters']['bias'] == bias
        assert f'\n{axis} ' in f'\n{session.stdout}'
        assert f'{axis}: ' in session.stderr
        assert str(folder / 'report.html') in session.stdout


def test_one_axis_that_fails_stops_all(start: Callable[..., Session]) -> None:
    session = start('--config', str(CONFIG), '--duration', '100')
    session.wait_for_samples('pan: ')
    session.wait_for_samples('tilt: ')
    os.kill(session.node('controller', '/tilt'), signal.SIGKILL)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'tilt/controller died (killed by SIGKILL)' in session.stderr
    assert 'pan/' not in session.stderr
    for axis in TRUTH:
        assert (session.out / axis / 'report.html').is_file()


def test_each_axis_gets_a_driver_in_whose_command_it_is_named(
    start: Callable[..., Session],
) -> None:
    driver = shlex.join([
        sys.executable, '-m', 'backlash_ros.nodes.plant', '--ros-args',
        '--params-file', str(CONFIG), '-r', '__ns:=/{axis}',
    ])
    session = start('--config', str(CONFIG), '--driver', driver, '--duration', '2')
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    for axis, truth in TRUTH.items():
        # What is learned in real time depends on the load of the machine.
        summary = json.loads((session.out / axis / 'summary.json').read_text())
        assert tuple(summary['truth'].values()) == truth
        assert 'samples' in (session.out / axis / 'logs' / 'driver.log').read_text()
        effective = yaml.safe_load((session.out / axis / 'parameters.yaml').read_text())
        named = effective['/bringup']['ros__parameters']['driver']
        assert shlex.split(named)[-1] == f'__ns:=/{axis}'


def test_one_axis_alone_can_be_taken_from_the_file(start: Callable[..., Session]) -> None:
    session = start('--config', str(CONFIG), '--axis', 'tilt', '--lockstep', '--duration', '2')
    assert session.wait() == 0, session.stderr
    assert [path.name for path in session.out.iterdir()] == ['tilt']
    assert_learned(session, 'tilt')


def test_axis_that_holds_a_bag_is_not_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / 'tilt' / 'bag').mkdir(parents=True)
    assert bringup.main(['--config', str(CONFIG), '--out', str(tmp_path)]) == 2
    assert 'holds a bag already' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['tilt']


def test_progress_names_the_axis_and_an_endless_run_has_no_total() -> None:
    stream = io.StringIO()
    progress = {'sample': 149, 'm': 1.0, 'lost': 0}
    ProgressDisplay(200, 0.01, stream, 'x').show(progress, 150)
    ProgressDisplay(0, 0.01, stream).show(progress, 150)
    first, second = stream.getvalue().splitlines()
    assert first.startswith('x:    1.50 s  150/200  m 1')
    assert second.startswith('   1.50 s  150  m 1')
