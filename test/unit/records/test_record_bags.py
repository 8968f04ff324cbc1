"""Bags: topics of the package, joint states with commands to joints, stamps that are none."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_bags import FLOAT, MULTI_ARRAY, TYPES, write_messages
from numpy.typing import NDArray

from backlash_ros import topics
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.records.reading import read_record

NUMBER, NUMBERS = FLOAT, MULTI_ARRAY
JOINTS = 'sensor_msgs/msg/JointState'
PERIOD_NS, COUNT = 5_000_000, 200
V = np.sin(0.1 * np.arange(COUNT))
Y = 0.9 * np.sin(0.1 * np.arange(COUNT) - 0.1)
STAMPS = 10**18 + PERIOD_NS * np.arange(COUNT)


def message(kind: str, value: Any) -> Any:
    types = TYPES.types
    if kind == NUMBER:
        return types[NUMBER](data=float(value))
    if kind == NUMBERS:
        layout = types['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
        return types[NUMBERS](layout=layout, data=np.array(value, dtype=float))
    header = types['std_msgs/msg/Header'](
        stamp=types['builtin_interfaces/msg/Time'](sec=0, nanosec=0), frame_id='')
    names, positions = zip(*value.items(), strict=True)
    none = np.zeros(0)
    return types[JOINTS](header=header, name=list(names), position=np.array(positions),
                         velocity=none, effort=none)


Topic = tuple[str, NDArray[np.int64], Sequence[Any]]  # type, stamps, values


def bag(path: Path, heard: dict[str, Topic]) -> Path:
    return write_messages(path, (
        (stamp, name, kind, bytes(TYPES.serialize_cdr(message(kind, value), kind)))
        for name, (kind, stamps, values) in heard.items()
        for stamp, value in zip(stamps.tolist(), values, strict=True)))


LATER = STAMPS + 500_000
TWO = [{'shoulder': 7.0, 'elbow': y} for y in Y]
ONE = [{'elbow': y} for y in Y]
COMMANDS: dict[str, tuple[dict[str, Topic], str]] = {
    'an array of one': (
        {'joint_states': (JOINTS, STAMPS, ONE),
         'forward_command_controller/commands': (NUMBERS, LATER, [[v] for v in V])}, ''),
    'an array, several joints': (
        {'joint_states': (JOINTS, STAMPS, TWO),
         'forward_command_controller/commands': (NUMBERS, LATER, [[v] for v in V])}, 'elbow'),
    'joint states as commands': (
        {'joint_states': (JOINTS, STAMPS, TWO),
         'robot_joint_command': (JOINTS, LATER, [{'elbow': v, 'shoulder': 3.0} for v in V])},
        'elbow'),
    'a number': (
        {'joint_states': (JOINTS, STAMPS, ONE), 'elbow/command': (NUMBER, LATER, V),
         'temperature': (NUMBER, LATER, V)}, ''),
    'a namespace': (
        {'arm/joint_states': (JOINTS, STAMPS, ONE),
         'arm/position_controller/commands': (NUMBERS, LATER, [[v] for v in V])}, '')}


@pytest.mark.parametrize('name', COMMANDS)
def test_joint_states_and_commands_are_y_and_v(tmp_path: Path, name: str) -> None:
    heard, joint = COMMANDS[name]
    record = read_record(bag(tmp_path / 'bag', heard), axis=joint)
    assert (record.sample_period, record.v.tolist()) == (pytest.approx(0.005), V.tolist())
    assert record.y.tolist() == Y.tolist()
    assert 'y is' in record.notes[0]


def test_of_several_joints_one_is_asked_for_and_may_be_named(tmp_path: Path) -> None:
    path = bag(tmp_path / 'bag', {
        'joint_states': (JOINTS, STAMPS, TWO),
        'commands': (NUMBERS, LATER, [[3.0, v] for v in V])})
    with pytest.raises(InputError, match='choose a joint with --axis') as told:
        read_record(path)
    assert 'commands[0], commands[1], joint_states/elbow, joint_states/shoulder' in str(told.value)
    columns = {'v': 'commands[1]', 'y': 'joint_states/elbow'}
    assert read_record(path, columns=columns).y.tolist() == Y.tolist()
    with pytest.raises(InputError, match='nothing: the signals are commands'):
        read_record(path, columns={'v': 'nothing'})


@pytest.mark.parametrize('stamp', [0, 2**63 - 1, 10**18 + 3 * 10**16])
@pytest.mark.parametrize('row', [0, 77, COUNT - 1])
def test_one_bad_stamp_is_dropped_and_counted(tmp_path: Path, stamp: int, row: int) -> None:
    stamps = STAMPS.copy()
    stamps[row] = stamp
    record = read_record(bag(tmp_path / 'bag', {
        topics.PLANT_OUTPUT: (NUMBER, stamps, Y), topics.CONTROL: (NUMBER, LATER, V)}))
    assert '1 message with a stamp far off left out' in record.timing
    first = int(row == 0)
    assert np.isnan(record.y).tolist() == [
        k == row for k in range(first, COUNT - (row == COUNT - 1))]
    assert record.v[:-1].tolist() == V[first:len(record.v) + first - 1].tolist()


def test_dropped_commands_are_said_and_the_motor_is_not_judged_by_them(tmp_path: Path) -> None:
    motor = np.append(0.0, V[:-1])
    record = read_record(bag(tmp_path / 'bag', {
        topics.PLANT_OUTPUT: (NUMBER, STAMPS, Y),
        topics.CONTROL: (NUMBER, np.delete(LATER, range(5, 150, 10)),
                               np.delete(V, range(5, 150, 10)).tolist()),
        topics.APPLIED_CONTROL: (NUMBER, STAMPS - 100_000, motor)}))
    assert record.notes == ('15 messages of control are missing: the one before is taken for them',)
    assert record.commands is None
    assert record.v[:-1].tolist() == V[:-1].tolist()


def test_nothing_that_may_be_v_or_y_is_told(tmp_path: Path) -> None:
    path = bag(tmp_path / 'bag', {'temperature': (NUMBER, STAMPS, Y)})
    with pytest.raises(InputError, match='temperature'):
        read_record(path)
