"""Nodes as processes: what they refuse at the start, how they end, what may change in between."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import Probe, ros_world

UNKNOWN_YAML = """
/**:
  ros__parameters:
    estimator:
      initial: {mm: 1.0}
"""
UNREADABLE_YAML = """
/**:
  ros__parameters:
    plant: {denominator: [1, -2.5]}
"""
ANOTHER_NODES_YAML = """
plant:
  ros__parameters: {backlash: {m: -1.0}}
"""


def test_bad_input_ends_a_node_with_one_line_and_exit_code_2(tmp_path: Path) -> None:
    for name, text in (('unknown', UNKNOWN_YAML), ('unreadable', UNREADABLE_YAML)):
        (tmp_path / f'{name}.yaml').write_text(text)
    (tmp_path / 'bag').mkdir()
    cases: list[tuple[str, list[str], str]] = [
        ('controller', ['-p', 'sample_period:=-0.01'], 'sample_period=-0.01 must be > 0 [s]'),
        ('controller', ['-p', 'estimator.use_applied_control:=1'],
         'estimator.use_applied_control=1 must be a text'),
        ('controller', ['--params-file', str(tmp_path / 'unknown.yaml')],
         'did you mean estimator.initial.m?'),
        ('plant', ['--params-file', str(tmp_path / 'unreadable.yaml')],
         'write all numbers of a list with a decimal point'),
        ('reference', ['-p', 'amplitude'], "'-p amplitude'"),
        ('recorder', ['-p', f"bag:='{tmp_path / 'bag'}'"], 'exists already: name a new folder'),
    ]
    with ros_world(tmp_path) as world:
        nodes = [
            world.start(executable, None, '--ros-args', *arguments)
            for executable, arguments, _ in cases
        ]
        nodes.append(world.start('reference', None, '--amplitude', '3'))
        answers = [(node.wait(), node.stderr) for node in nodes]
    complaints = [complaint for *_, complaint in cases] + ['unrecognized arguments: --amplitude 3']
    for node, (code, stderr), complaint in zip(nodes, answers, complaints, strict=True):
        assert complaint in stderr
        assert stderr.startswith(f'{node.executable}: ')
        assert (code, stderr.count('\n')) == (2, 1), stderr
        assert 'Traceback' not in stderr


def test_help_says_what_the_node_is_and_its_parameters_as_in_a_file(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        node = world.start('controller', None, '--help')
        assert node.wait() == 0
        told = node.stdout
    assert 'Node that learns the backlash and cancels it' in told
    assert '* control.max: .inf\n      largest v [v]\n' in told
    assert '  lockstep: false\n' in told
    assert '  plant.numerator: [1e-05, 4e-05, 1e-05]\n' in told
    for line in told.splitlines():
        assert not line.endswith(':') or line.startswith(('options', 'parameters')), line
        assert 'False' not in line


def test_topics_follow_the_name_of_their_node(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        for name in ('controller', 'plant'):
            world.start(name, None, '--ros-args', '-r', f'__node:=left_{name}')
        probe = world.probe()
        expected = {'/left_controller/estimates', '/left_controller/signals', '/left_plant/truth'}
        probe.wait_until(
            lambda: expected <= dict(probe.node.get_topic_names_and_types()).keys(), 'the topics'
        )
        private = {
            topic for topic, _ in probe.node.get_topic_names_and_types()
            if topic.endswith(('/estimates', '/signals', '/truth'))
        }
        assert private == expected


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=lambda s: s.name)
def test_a_signal_ends_every_node_with_exit_code_0(
    tmp_path: Path, number: signal.Signals,
) -> None:
    (tmp_path / 'plant.yaml').write_text(ANOTHER_NODES_YAML)
    with ros_world(tmp_path) as world:
        nodes = [
            world.start('controller', {'estimator.law': 'lms', 'control.max': 12}),
            world.start('plant', {'plant.numerator': [1, 2], 'sample_period': 0.0005}),
            # Sections of other nodes are not its business.
            world.start('reference', {'sample_period': 0.0005}, '--params-file',
                        str(tmp_path / 'plant.yaml')),
            world.start('recorder', {'bag': f"'{tmp_path / 'bag'}'"}),
        ]
        for node in nodes:
            node.wait_for('ready')
        for node in nodes:
            node.send(number)
        assert [node.wait() for node in nodes] == [0, 0, 0, 0], [node.stderr for node in nodes]
        assert not any('Traceback' in node.stderr for node in nodes)
    assert (tmp_path / 'bag' / 'metadata.yaml').is_file()


def change(probe: Probe, atomically: bool, **values: Any) -> list[Any]:
    """Results of setting parameters of the controller; __ stands for a dot."""
    client = AsyncParameterClient(probe.node, 'controller')
    probe.wait_until(client.services_are_ready, 'the parameter services')
    parameters = [
        Parameter(name.replace('__', '.'), value=value) for name, value in values.items()
    ]
    send = client.set_parameters_atomically if atomically else client.set_parameters
    future = send(parameters)
    probe.wait_until(future.done, 'an answer')
    response = future.result()
    return [response.result] if atomically else list(response.results)


def value_of(probe: Probe, name: str) -> float:
    client = AsyncParameterClient(probe.node, 'controller')
    future = client.get_parameters([name])
    probe.wait_until(future.done, 'an answer')
    return float(future.result().values[0].double_value)


def test_live_parameters_change_all_or_nothing_and_the_others_not_at_all(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller')
        probe = world.probe()
        controller.wait_for('ready')
        # A whole number serves as a float.
        (accepted,) = change(probe, False, control__max=5)
        assert accepted.successful
        assert value_of(probe, 'control.max') == 5.0
        (refused,) = change(probe, True, lms__step=0.5, control__min=6.0)
        assert not refused.successful
        assert refused.reason == 'control.min=6.0 must be < control.max=5.0'
        assert value_of(probe, 'lms.step') == 1.0
        (fixed,) = change(probe, False, sample_period=0.02)
        assert not fixed.successful
        assert 'read-only' in fixed.reason
        (out_of_bounds,) = change(probe, False, inverse__direction_band=-1.0)
        assert out_of_bounds.reason == 'inverse.direction_band=-1.0 must be >= 0 [u]'
        assert controller.stop() == 0
