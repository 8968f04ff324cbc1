"""Sections of a parameter file that do not reach the node they are meant for."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from places import ROOT
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import ros_world

from backlash_ros.nodes.runtime.unused_sections import unused

CONFIGS = sorted((ROOT / 'config').glob('*.yaml'))


@pytest.mark.parametrize(('sections', 'full_name', 'cure'), [
    (['/**', '/plant'], '/arm/plant', '/**/plant'),
    (['/arm/plant'], '/plant', '/**/plant'),
    (['/plant'], '/left_plant', '/**/left_plant'),
    (['/plnt'], '/plant', '/**/plant'),
])
def test_section_that_does_not_reach_its_node_is_named(
    sections: list[str], full_name: str, cure: str,
) -> None:
    assert list(unused(sections, 'plant', full_name)) == [(sections[-1], cure)]


@pytest.mark.parametrize(('sections', 'full_name'), [
    (['/**', '/plant'], '/plant'), (['/**/plant'], '/plant'), (['/**/plant'], '/a/b/plant'),
    (['/*/plant'], '/a/plant'), (['/pan/plant', '/tilt/plant'], '/pan/plant'),
    (['/**', '/tilt/plant'], '/pan/plant'), (['/**', '/controller', '/somebody_else'], '/plant'),
    (['/tilt/**'], '/pan/plant'),
])
def test_other_sections_are_no_concern(sections: list[str], full_name: str) -> None:
    assert list(unused(sections, 'plant', full_name)) == []


@pytest.mark.parametrize('path', CONFIGS, ids=lambda path: path.name)
def test_shipped_sections_reach_their_nodes_in_any_namespace(path: Path) -> None:
    sections = list(yaml.safe_load(path.read_text()))
    for node in ('controller', 'plant', 'reference', 'recorder'):
        assert list(unused(sections, node, f'/arm/{node}')) == []


def test_nodes_in_a_namespace_use_the_shipped_file_and_warn_of_what_they_do_not(
    tmp_path: Path,
) -> None:
    (tmp_path / 'mine.yaml').write_text('/plant: {ros__parameters: {seed: 7}}\n')
    shipped = next(path for path in CONFIGS if path.name == 'geared_motor.yaml')
    with ros_world(tmp_path) as world:
        plant = world.start('plant', None, '--ros-args', '-r', '__ns:=/arm', '--params-file',
                            str(shipped), '--params-file', str(tmp_path / 'mine.yaml'))
        probe = world.probe()
        client = AsyncParameterClient(probe.node, '/arm/plant')
        probe.wait_until(client.services_are_ready, 'the parameter services')
        answer = client.get_parameters(['backlash.m'])
        probe.wait_until(answer.done, 'the slope')
        assert answer.result().values[0] == Parameter(
            'm', value=0.098).get_parameter_value()
        probe.wait_until(lambda: 'mine.yaml' in plant.stderr, 'the warning')
        assert plant.stop() == 0
    (line,) = [line for line in plant.stderr.splitlines() if 'WARN' in line]
    assert line.endswith('section /plant is not for /arm/plant, its values are not used: '
                         'write /**/plant')
