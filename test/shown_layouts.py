"""What the shipped layouts of PlotJuggler and Foxglove draw: topics, fields, indices."""

import re

from places import ROOT
from std_msgs.msg import Float64, Float64MultiArray

TYPES = {'std_msgs/msg/Float64': Float64, 'std_msgs/msg/Float64MultiArray': Float64MultiArray}
# PlotJuggler writes /topic/field[0], Foxglove /topic.field[0].
SHOWN = {
    'plotjuggler.xml': r'(?:name|curve_x|curve_y)="(/\S+)/(\w+)(?:\[(\d+)\])?"',
    'foxglove.json': r'"value": *"(/[\w/]+)\.(\w+)(?:\[(\d+)\])?"',
}
# Topic, field and index, -1 without one.
PATHS = {
    (topic, field, int(index or -1)) for name, path in SHOWN.items()
    for topic, field, index in re.findall(path, (ROOT / 'config' / name).read_text())
}
