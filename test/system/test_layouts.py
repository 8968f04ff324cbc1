"""The shipped layouts of PlotJuggler and Foxglove show what a running controller publishes."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from drivers.paced_driver import controller_and_driver
from places import ROOT
from ros_processes import ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics

CONFIG = ROOT / 'config'
TYPES: dict[str, type[Any]] = {
    'std_msgs/msg/Float64': Float64, 'std_msgs/msg/Float64MultiArray': Float64MultiArray,
    'diagnostic_msgs/msg/DiagnosticArray': DiagnosticArray,
}
PLOTJUGGLER = ElementTree.parse(CONFIG / 'plotjuggler.xml').getroot()
FOXGLOVE = json.loads((CONFIG / 'foxglove.json').read_text())
PANELS: dict[str, dict[str, Any]] = FOXGLOVE['configById']
# PlotJuggler writes /topic/field[0], Foxglove /topic.field[0].
PLOTJUGGLER_PATH = re.compile(r'(?P<topic>/\S+)/(?P<field>\w+)(?:\[(?P<index>\d+)\])?')
FOXGLOVE_PATH = re.compile(r'(?P<topic>/[\w/]+)\.(?P<field>\w+)(?:\[(?P<index>\d+)\])?')


def curves() -> Iterator[str]:
    """The series that PlotJuggler is told to draw."""
    for curve in PLOTJUGGLER.iter('curve'):
        if 'curve_x' in curve.attrib:
            yield from (curve.attrib['curve_x'], curve.attrib['curve_y'])
        else:
            yield curve.attrib['name']


def foxglove_paths() -> Iterator[str]:
    """The message paths that Foxglove is told to draw."""
    for panel in PANELS.values():
        yield from (path['value'] for path in panel.get('paths', []))
        if 'xAxisPath' in panel:
            yield panel['xAxisPath']['value']


def parts(pattern: re.Pattern[str], path: str) -> tuple[str, str, int]:
    """Topic, field and index (-1 without one) of a path."""
    found = pattern.fullmatch(path)
    assert found, path
    return found['topic'], found['field'], int(found['index'] or -1)


ALL_PARTS = {
    *(parts(PLOTJUGGLER_PATH, path) for path in curves()),
    *(parts(FOXGLOVE_PATH, path) for path in foxglove_paths()),
}


def panels_in(tree: object) -> Iterator[str]:
    """The panels of a tree of splits."""
    if isinstance(tree, dict):
        yield from panels_in(tree['first'])
        yield from panels_in(tree['second'])
    else:
        yield str(tree)


@pytest.mark.parametrize('paths', [
    {parts(PLOTJUGGLER_PATH, path) for path in curves()},
    {parts(FOXGLOVE_PATH, path) for path in foxglove_paths()},
], ids=['plotjuggler', 'foxglove'])
def test_a_layout_shows_estimates_with_bands_signals_loop_status_and_latency(
    paths: set[tuple[str, str, int]],
) -> None:
    labels = {'y_m', 'y', 'u_d', 'v', 'status', 'latency_s', 'innovation', 'gap'}
    labels |= {f'{name}{end}' for name in ('m', 'c_r', 'c_l') for end in ('', '_low', '_high')}
    of_the_loop = {topics.SIGNAL_LABELS.index('v'), topics.SIGNAL_LABELS.index('u_hat')}
    assert paths == {
        *((f'/{topics.watched(label)}', 'data', -1) for label in labels),
        *((f'/{topics.SIGNALS}', 'data', index) for index in of_the_loop),
    }


def test_abscissa_and_ordinate_of_the_loop_are_v_and_u_of_one_message() -> None:
    v, u = (f'data[{topics.SIGNAL_LABELS.index(label)}]' for label in ('v', 'u_hat'))
    drawn = [curve for curve in PLOTJUGGLER.iter('curve') if 'curve_x' in curve.attrib]
    assert [(c.attrib['curve_x'], c.attrib['curve_y']) for c in drawn] == [
        (f'/{topics.SIGNALS}/{v}', f'/{topics.SIGNALS}/{u}')
    ]
    panel = PANELS['Plot!loop']
    assert panel['xAxisVal'] == 'custom'
    assert panel['xAxisPath']['value'] == f'/{topics.SIGNALS}.{v}'
    assert [path['value'] for path in panel['paths']] == [f'/{topics.SIGNALS}.{u}']


def test_plotjuggler_subscribes_to_what_it_draws() -> None:
    selected = PLOTJUGGLER.find('Plugins/plugin/selected_topics')
    streamer = PLOTJUGGLER.find('previouslyLoaded_Streamer')
    plugin = PLOTJUGGLER.find('Plugins/plugin')
    assert selected is not None
    assert streamer is not None
    assert plugin is not None
    assert plugin.attrib['ID'] == streamer.attrib['name']
    listed = selected.attrib['value'].split(';')
    assert sorted(listed) == sorted({parts(PLOTJUGGLER_PATH, path)[0] for path in curves()})


def test_splitters_of_plotjuggler_count_their_parts() -> None:
    splitters = list(PLOTJUGGLER.iter('DockSplitter'))
    assert splitters
    for splitter in splitters:
        sizes = splitter.attrib['sizes'].split(';')
        assert int(splitter.attrib['count']) == len(splitter) == len(sizes)


def test_every_panel_of_foxglove_has_its_place() -> None:
    assert sorted(panels_in(FOXGLOVE['layout'])) == sorted(PANELS)


def test_every_path_is_published(tmp_path: Path) -> None:
    diagnostics = PANELS['DiagnosticStatusPanel!controller']
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        present = dict(driver.probe.node.get_topic_names_and_types())
        heard: dict[str, list[Any]] = {}
        for topic in {diagnostics['topicToRender'], *(topic for topic, _, _ in ALL_PARTS)}:
            [name] = present[topic]
            heard[topic] = driver.probe.collect(topic, TYPES[name])
        driver.run_until(lambda: all(heard.values()), 'a message of each topic')
        for topic, field, index in ALL_PARTS:
            value = getattr(heard[topic][-1], field)
            assert isinstance(value if index < 0 else value[index], float), topic
        driver.run_until(
            lambda: any(
                (status.hardware_id, status.name)
                == (diagnostics['selectedHardwareId'], diagnostics['selectedName'])
                for message in heard[diagnostics['topicToRender']] for status in message.status
            ), 'the diagnostics that are shown',
        )
        assert controller.stop() == 0
