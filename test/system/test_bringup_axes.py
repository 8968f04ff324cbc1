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
from places import ROOT

from backlash_ros.tools.bringup import command as bringup
from backlash_ros.tools.bringup.orchestrator import prepare
from backlash_ros.tools.bringup.progress import ProgressDisplay
from backlash_ros.tools.bringup.run_plan import RunPlan, plan_processes

CONFIG = ROOT / 'config' / 'two_axes.yaml'
TRUTH = {'pan': (1.3, 3.0, -3.0), 'tilt': (0.8, 1.0, -2.0)}
# A plant in the place of a driver, which begins when controller, reference and recorder listen.
DRIVER = shlex.join([
    sys.executable, '-m', 'backlash_ros.nodes.plant', '--ros-args', '--params-file', str(CONFIG),
    '-p', 'wait_for_subscribers:=3', '-r', '__ns:=/{axis}',
])


def assert_learned(session: Session, axis: str) -> None:
    final = json.loads((session.out / axis / 'summary.json').read_text())['final']
    for name, truth in zip(('m', 'c_r', 'c_l'), TRUTH[axis], strict=True):
        assert final[name] == pytest.approx(truth, rel=0.01)


def test_each_axis_learns_its_own_backlash_in_a_time_of_its_own(
    start: Callable[..., Session],
) -> None:
    session = start(
        '--config', str(CONFIG), '--lockstep', '--duration', '1', '--seed', '4',
        '--set', 'bias=0.5', '--set', 'tilt/bias=0.25',
    )
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert sorted(path.name for path in session.out.iterdir()) == ['pan', 'tilt']
    for axis, bias in (('pan', 0.5), ('tilt', 0.25)):
        folder = session.out / axis
        summary = json.loads((folder / 'summary.json').read_text())
        assert (summary['samples'], summary['lost_samples']) == (100, 0)
        assert_learned(session, axis)
        assert bag_counts(folder / 'bag')[f'{axis}/plant_output'] == 100
        assert (folder / 'logs' / 'controller.log').is_file()
        effective = yaml.safe_load((folder / 'parameters.yaml').read_text())
        assert list(effective) == ['/**']
        assert effective['/**']['ros__parameters']['bias'] == bias
        assert f'\n{axis} ' in f'\n{session.stdout}'
        assert f'{axis}: ' in session.stderr
        assert str(folder / 'report.html') in session.stdout


def test_one_axis_that_fails_stops_all_and_their_drivers(start: Callable[..., Session]) -> None:
    session = start('--config', str(CONFIG), '--unlimited', '--driver', DRIVER, '--duration', '100')
    session.wait_for_samples('pan: ')
    session.wait_for_samples('tilt: ')
    os.kill(session.node('controller', '/tilt'), signal.SIGKILL)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'tilt/controller died (killed by SIGKILL)' in session.stderr
    assert 'pan/' not in session.stderr
    for axis in TRUTH:
        assert (session.out / axis / 'report.html').is_file()
        # The plant in the place of the driver says so when it ends.
        assert 'samples' in (session.out / axis / 'logs' / 'driver.log').read_text()


def planned(folder: Path, *arguments: str) -> RunPlan:
    """The plan that these arguments lead to, its files in the folder."""
    return prepare(bringup.parse_options(
        ['--config', str(CONFIG), '--out', str(folder), *arguments]
    ))


def test_each_axis_gets_a_driver_in_whose_command_it_is_named(tmp_path: Path) -> None:
    drivers = plan_processes(planned(tmp_path, '--unlimited', '--driver', DRIVER), None)[1]
    assert [process.name for process in drivers] == ['pan/driver', 'tilt/driver']
    for axis, process in zip(TRUTH, drivers, strict=True):
        assert process.command[-1] == f'__ns:=/{axis}'
        assert process.log == tmp_path / axis / 'logs' / 'driver.log'
        effective = yaml.safe_load((tmp_path / axis / 'parameters.yaml').read_text())
        named = effective['/bringup']['ros__parameters']['driver']
        assert tuple(shlex.split(named)) == process.command


def test_one_axis_alone_can_be_taken_from_the_file(tmp_path: Path) -> None:
    plan = planned(tmp_path, '--axis', 'tilt', '--lockstep')
    (axis,) = plan.axes
    assert axis.name == 'tilt'
    assert [path.name for path in tmp_path.iterdir()] == ['tilt']
    values = [axis.parameters.get_float(f'backlash.{name}') for name in ('m', 'c_r', 'c_l')]
    assert (*values, axis.parameters.get_float('frequency')) == (*TRUTH['tilt'], 9.0)
    processes = [process for stage in plan_processes(plan, None) for process in stage]
    assert [process.name for process in processes] == [
        'tilt/plant', 'tilt/reference', 'tilt/controller', 'tilt/recorder',
    ]
    assert all('__ns:=/tilt' in process.command for process in processes)


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


def test_a_section_of_the_plant_is_no_mistake_where_there_is_a_driver(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    config = tmp_path / 'mine.yaml'
    common = '/**: {ros__parameters: {control: {min: -1.0, max: 1.0, rate_max: 9.0}'
    noise = 'estimator: {output_noise_std: 1.0e-4}'
    of_plant = '/**/plant: {ros__parameters: {output_quantum: 0.1, seed: 3}}'
    for number, (text, said) in enumerate((
        (f'{common}, {noise}}}}}\n{of_plant}', False),
        (f'{common}, {noise}, seed: 3}}}}', True),
        (f'{common}}}}}\n{of_plant}', True),  # the noise of the estimator follows the quantum
    )):
        config.write_text(text)
        prepare(bringup.parse_options([
            '--config', str(config), '--driver', 'none', '--out', str(tmp_path / str(number)),
        ]))
        assert ('no use for' in capsys.readouterr().err) is said
