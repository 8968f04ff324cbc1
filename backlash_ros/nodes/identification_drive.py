"""Node behind `identify --drive`: moves an actuator so that it can be identified, and records."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from rclpy.utilities import remove_ros_args

from backlash_ros import topics
from backlash_ros.core.identification.motion import strokes
from backlash_ros.nodes.drive.motion_node import MotionNode
from backlash_ros.nodes.runtime.process import ros_arguments, run
from backlash_ros.options import DONE, FAILED, add_motion_options


class IdentificationDriveNode(MotionNode):
    """Writes what it hears and sends as it goes.

    Each line of the file is a message: topic, time stamp [ns], value.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__('identify', options, strokes)
        self._file = options.messages.open('w', encoding='ascii')
        self._written = Counter[str]()

    def look(self) -> None:
        super().look()
        for topic, messages in self.heard.by_topic.items():
            for message in messages[self._written[topic]:]:
                print(topic, message.stamp_ns, repr(message.value), sep=',', file=self._file)
            self._written[topic] = len(messages)
        self._file.flush()

    def tell(self) -> None:
        self._file.close()
        if self.ended:
            self.say(f'{self.ended}: drive ended')
        if self.motion is None:
            why = f'nobody subscribes to {self.names[topics.CONTROL]}' if self.heard.outputs \
                else f'nothing was heard on {self.names[topics.PLANT_OUTPUT]}'
            self.say(f'the actuator was not moved: {why}')
        self.exit_code = FAILED if self.motion is None else DONE


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code. The options are those that `identify` has checked."""
    arguments = sys.argv[1:] if args is None else args
    parser = argparse.ArgumentParser(prog='identify')
    parser.set_defaults(drive=True)
    parser.add_argument('--messages', type=Path, required=True)
    parser.add_argument('--config', required=True)
    add_motion_options(parser, 10.0, 'how long to listen')
    options = parser.parse_args(remove_ros_args(['', *arguments])[1:])
    return run('identify', lambda: IdentificationDriveNode(options),
               ['--ros-args', '--params-file', options.config, *ros_arguments(arguments)])


if __name__ == '__main__':
    sys.exit(main())
