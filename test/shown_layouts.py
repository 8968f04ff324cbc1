"""What the shipped layouts of PlotJuggler and Foxglove draw: topics, fields, indices."""

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

from places import ROOT
from std_msgs.msg import Float64, Float64MultiArray

CONFIG = ROOT / 'config'
TYPES: dict[str, type[Any]] = {
    'std_msgs/msg/Float64': Float64, 'std_msgs/msg/Float64MultiArray': Float64MultiArray,
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


PATHS = {
    *(parts(PLOTJUGGLER_PATH, path) for path in curves()),
    *(parts(FOXGLOVE_PATH, path) for path in foxglove_paths()),
}
