"""What bringup makes of its arguments, and how long it waits for the samples of an axis."""

import os
import shlex
import sys
from pathlib import Path

import pytest
import yaml
from places import ROOT

from backlash_ros.tools.bringup import __main__ as bringup
from backlash_ros.tools.bringup.plan import (
    START_DEADLINE_S,
    Axis,
    plan_processes,
    prepare,
    stop_times,
)
from backlash_ros.tools.bringup.supervisor import Child, child_environment, foreign_environment
from backlash_ros.tools.cli import BrokenOffError
from backlash_ros.tools.config import read_configuration

CONFIG = ROOT / 'config' / 'two_axes.yaml'
DRIVER = 'drive --axis {axis}'


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--set', 'estimator.initial.cr=1'], ['estimator.initial.cr', 'estimator.initial.c_r?']),
    (['--set', 'backlash.m=-1'], ['backlash.m=-1.0', 'must be > 0']),
    (['--set', 'estimator.bounds.m=[2, 1]'], ['estimator.bounds.m', 'low < high']),
    (['--set', 'plant.denominator=[0, 0]'], ['plant.denominator']),
    (['--set', 'control.min=3', '--set', 'control.max=2'], ['control.min', 'control.max']),
    (['--set', 'waveform=file'], ['file', 'CSV']),
    (['--duration', '0.015'], ['duration', '0.015', 'sample_period']),
    (['--duration', '-1'], ['duration', '-1']), (['--duration', 'long'], ['--duration', 'long']),
    (['--driver', 'x', '--lockstep'], ["driver='x'", 'excludes lockstep', 'does not wait']),
    (['--driver', 'x'], ['control.min=-inf', 'set control.min, control.max, control.rate_max',
                         'give --unlimited']),
    (['--driver', 'none', '--set', 'control.min=-5', '--set', 'control.max=5'], [
        'control.rate_max=inf', 'set control.rate_max, or']),
    (['--driver', "x 'y"], ['driver', 'is not a command', 'quotation']),
    (['--axis', 'x'], ["axis='x' must stand", 'axes', '/bringup']),
    (['--set', 'x/seed=3'], ['x/seed', "axis='x' must"]),
    (['--set', 'axes=[a, b]', '--set', 'b/backlash.c_l=4'], ['b: backlash.c_l=4.0', '<']),
    (['--set', 'axes=[a, b]', '--set', 'estimates.file=e'], ["'e'", 'of a and of b']),
    (['--set', 'axes=[a, b, c, d, e, f, g, h]'], ['8 axes', 'at most 7']),
    (['--config', 'arm.yaml'], ["driver=''", 'several joints', '`simulate --axis JOINT`']),
    (['--config', 'arm.yaml', '--driver', 'x', '--set', 'waist/control.max=.inf'],
     ['waist.control.max=inf', 'give --unlimited']),
    (['--config', 'nowhere.yaml'], ['nowhere.yaml']), (['--speed', '3'], ['--speed']),
    (['--out', '/proc/nowhere'], ['/proc/nowhere']),
    (['--live-port', '70000'], ['--live-port', '70000 must be from 0']),
])
def test_bad_input_is_refused_in_one_line_before_anything_is_made(
    arguments: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert bringup.main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ''
    assert said.err.startswith('bringup: ')
    assert said.err.count('\n') == 1
    for word in words:
        assert word in said.err
    assert list(tmp_path.iterdir()) == []


def test_folder_that_holds_a_bag_is_not_written_over(tmp_path, capsys):
    (tmp_path / 'bag').mkdir()
    assert bringup.main(['--out', str(tmp_path)]) == 2
    assert 'holds a bag already' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


def test_what_the_user_has_set_reaches_the_nodes(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    environment = child_environment(tmp_path, 7)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE')
    environment = child_environment(tmp_path, 9)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert environment['ROS_DOMAIN_ID'] == '9'


def plan(folder: Path, driver: str, *names: str, **values: object) -> list[Axis]:
    parameters = read_configuration(None).parameters().replaced({'driver': driver, **values})
    return [Axis(name, parameters, folder / name) for name in names or ('',)]


def names_of(stages: list[list[Child]]) -> list[list[str]]:
    return [[process.name for process in stage] for stage in stages]


def test_plant_stops_first_but_a_driver_only_after_the_controller(tmp_path: Path) -> None:
    assert names_of(plan_processes(plan(tmp_path, ''))) == [
        ['plant'], ['reference'], ['controller'], ['recorder']]
    stages = plan_processes(plan(tmp_path, 'run it'))
    assert names_of(stages) == [['controller'], ['driver'], ['reference'], ['recorder']]
    assert stages[1][0].command == ['run', 'it']
    assert stop_times(plan(tmp_path, 'run it', sample_period=0.05)) == (0.1, 0.5)
    assert stop_times(plan(tmp_path, '', **{'timeout.ramp': 20.0})) == (0.0, 20.0)
    assert names_of(plan_processes(plan(tmp_path, 'none'))) == [
        ['controller'], [], ['reference'], ['recorder']]


def test_axes_with_the_same_command_share_one_driver(tmp_path: Path) -> None:
    stages = plan_processes(plan(tmp_path, 'both --axes', 'x', 'y'))
    assert names_of(stages) == [
        ['x/controller', 'y/controller'], ['driver of x, y'], ['x/reference', 'y/reference'],
        ['x/recorder', 'y/recorder']]
    assert stages[1][0].log == tmp_path / 'x' / 'logs' / 'driver.log'


def test_foreign_program_gets_no_variables_that_were_made_for_this_python() -> None:
    own, user = f'{sys.prefix}/lib', '/opt/user/lib'
    made = {
        '_ROS_WHEELS_BOOTSTRAP_COMPLETE': '1', 'BACKLASH_ROS_EVENTS': '1', 'HOME': '/home',
        'LD_LIBRARY_PATH': os.pathsep.join([own, user])}
    assert foreign_environment(made) == {'HOME': '/home', 'LD_LIBRARY_PATH': user}
    del made['_ROS_WHEELS_BOOTSTRAP_COMPLETE']
    assert foreign_environment(made)['LD_LIBRARY_PATH'] == made['LD_LIBRARY_PATH']


def planned(folder: Path, *arguments: str) -> list[Axis]:
    return prepare(bringup.parse_options(
        ['--config', str(CONFIG), '--out', str(folder), *arguments]))


def test_each_axis_gets_a_driver_in_whose_command_it_is_named(tmp_path: Path) -> None:
    drivers = plan_processes(planned(tmp_path, '--unlimited', '--driver', DRIVER))[1]
    assert [process.name for process in drivers] == ['pan/driver', 'tilt/driver']
    for axis, process in zip(('pan', 'tilt'), drivers, strict=True):
        assert process.command == ['drive', '--axis', axis]
        assert process.log == tmp_path / axis / 'logs' / 'driver.log'
        effective = yaml.safe_load((tmp_path / axis / 'parameters.yaml').read_text())
        named = effective['/**']['ros__parameters']['driver']
        assert shlex.split(named) == process.command


def test_one_axis_alone_can_be_taken_from_the_file(tmp_path: Path) -> None:
    (axis,) = planned(tmp_path, '--axis', 'tilt', '--lockstep')
    assert (axis.name, [path.name for path in tmp_path.iterdir()]) == ('tilt', ['tilt'])
    values = [axis.parameters[f'backlash.{name}'] for name in ('m', 'c_r', 'c_l')]
    assert (*values, axis.parameters.frequency) == (0.8, 1.0, -2.0, 9.0)
    processes = [process for stage in plan_processes([axis]) for process in stage]
    assert [process.name for process in processes] == [
        'tilt/plant', 'tilt/reference', 'tilt/controller', 'tilt/recorder']
    assert all('__ns:=/tilt' in process.command for process in processes)


def begun(folder: Path, driver: str = '', **values: object) -> Axis:
    p = read_configuration(None).parameters().replaced({'samples': 100, 'driver': driver, **values})
    return Axis('', p, folder)


def let_pass(axis: Axis, seconds: float) -> None:
    axis.moved -= seconds


def test_samples_of_a_driver_that_ran_before_count_from_the_first_one_heard(tmp_path):
    axis = begun(tmp_path, 'some command')
    axis.take({'sample': 5000})
    assert not axis.complete
    axis.take({'sample': 5099})
    assert axis.complete


def test_a_plant_is_complete_once_all_that_it_says_was_heard_or_waited_for(tmp_path):
    axis = begun(tmp_path)
    axis.take({'sample': 41, 'received': {'plant_output': 42}})
    assert not axis.complete
    axis.published = {'samples': 100, 'plant_output': 42}
    let_pass(axis, 9.0)
    assert not axis.complete
    let_pass(axis, 2.0)
    assert axis.complete
    axis.take({'sample': 99, 'received': {'plant_output': 41}})
    assert not axis.complete
    axis.take({'sample': 99, 'received': {'plant_output': 42}})
    assert axis.complete


def test_a_plant_that_stands_still_is_an_error_that_names_the_last_sample(tmp_path: Path) -> None:
    axis = begun(tmp_path, lockstep=True)
    axis.take({'sample': 41})
    let_pass(axis, 9.0)
    axis.check_pace()
    let_pass(axis, 2.0)
    with pytest.raises(BrokenOffError, match=r'no new sample for .* after sample 41, see '):
        axis.check_pace()


def test_a_driver_that_falls_silent_is_waited_for_and_named_once(tmp_path, capsys):
    axis = begun(tmp_path, 'some command', samples=0)
    axis.take({'sample': 7})
    let_pass(axis, 11.0)
    for _ in range(3):
        axis.check_pace()
    assert capsys.readouterr().err.count('after sample 7, waiting for the driver') == 1
    axis.take({'sample': 8})
    let_pass(axis, 11.0)
    axis.check_pace()
    assert capsys.readouterr().err.count('waiting for the driver') == 1


def test_a_driver_without_a_first_sample_is_an_error_unless_somebody_else_starts_it(tmp_path):
    for driver in ('some command', 'none'):
        axis = begun(tmp_path, driver)
        let_pass(axis, START_DEADLINE_S - 1.0)
        axis.check_pace()
        let_pass(axis, 2.0)
        if driver == 'none':
            axis.check_pace()
        else:
            with pytest.raises(BrokenOffError, match=r'does the driver .* publish its output'):
                axis.check_pace()
