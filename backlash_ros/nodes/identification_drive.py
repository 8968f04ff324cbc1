"""Node behind `identify --drive`: moves an actuator so that it can be identified, and records."""

from __future__ import annotations

import argparse
import sys
from math import inf
from pathlib import Path

from rclpy.utilities import remove_ros_args

from backlash_ros import topics
from backlash_ros.core.driver_check.findings import Message
from backlash_ros.core.driver_check.gentle_drive import Drive, IdentificationDrive, Range
from backlash_ros.nodes.check_driver import CheckDriverNode
from backlash_ros.nodes.runtime.process import ros_arguments, run
from backlash_ros.options import DONE, FAILED

EXECUTABLE = 'identify'


class IdentificationDriveNode(CheckDriverNode):
    """Waits for a driver, moves v, comes to rest; writes what it heard and sent as it goes.

    Each line of the file is a message: topic, time stamp [ns], value.
    """

    program = EXECUTABLE

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options)
        self._file = options.messages.open('w', encoding='ascii')
        self._written: dict[str, int] = {}

    def _begin_drive(self, limits: Range) -> Drive:
        return IdentificationDrive(
            limits, self._period, self._options.duration, self._v_at_start()
        )

    def _look_at_graph(self) -> None:
        super()._look_at_graph()
        self._write()

    def _write(self) -> None:
        """Append what is new."""
        heard = self._heard
        for topic, messages in (
            (topics.CONTROL, heard.controls), (topics.APPLIED_CONTROL, heard.applied),
            (topics.PLANT_OUTPUT, heard.outputs),
        ):
            self._file.writelines(
                _line(topic, message) for message in messages[self._written.get(topic, 0):]
            )
            self._written[topic] = len(messages)
        self._file.flush()

    def _tell(self) -> None:
        self._write()
        self._file.close()
        if self._range_left is not None:
            print(f'{EXECUTABLE}: y = {self._range_left:.4g} left --output-range: drive ended',
                  file=sys.stderr)
        outputs = self._names[topics.PLANT_OUTPUT]
        if self._drive is not None and self._silent_s:
            print(f'{EXECUTABLE}: nothing was heard on {outputs} for {self._silent_s:g} s: drive '
                  'ended', file=sys.stderr)
        if self._drive is None:
            why = 'nobody subscribes to ' + self._names[topics.CONTROL] if self._heard.outputs \
                else f'nothing was heard on {outputs}'
            print(f'{EXECUTABLE}: the actuator was not moved: {why}', file=sys.stderr)
        self.exit_code = DONE if self._drive is not None else FAILED


def _line(topic: str, message: Message) -> str:
    return f'{topic},{message.stamp_ns},{message.value!r}\n'


def _options(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=EXECUTABLE)
    parser.add_argument('--messages', type=Path, required=True)
    parser.add_argument('--config', required=True)
    for name in ('duration', 'wait', 'rest'):
        parser.add_argument(f'--{name}', type=float, required=True)
    for name in ('amplitude', 'rate'):
        parser.add_argument(f'--{name}', type=float)
    parser.add_argument('--output-range', type=float, nargs=2, default=(-inf, inf))
    options = parser.parse_args(arguments)
    options.drive = True
    return options


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if args is None else args
    options = _options(remove_ros_args(['', *arguments])[1:])
    return run(
        EXECUTABLE, lambda: IdentificationDriveNode(options),
        ['--ros-args', '--params-file', options.config, *ros_arguments(arguments)],
    )


if __name__ == '__main__':
    sys.exit(main())
