"""`identify --drive`: let a node move the actuator, and identify the record while it grows."""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from backlash_ros import topics
from backlash_ros.core.parameters import Parameters, Value
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.middleware import ROS_MISSING, ros_is_missing
from backlash_ros.options import BAD_INPUT
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests
from backlash_ros.tools.config import write_config
from backlash_ros.tools.identify.outcome import identify_record
from backlash_ros.tools.records.messages import FEWEST_MESSAGES, from_messages


def drive(
    options: argparse.Namespace, given: Mapping[str, Value], period: float | None,
    ros_arguments: Sequence[str],
) -> Record:
    """Move the actuator and return the record. period [s]: from the stamps if None.

    Raises InputError if the node refused to move it, BrokenOffError if it was interrupted, if there
    is no record, or without ROS 2.
    """
    if ros_is_missing():
        raise BrokenOffError(ROS_MISSING)
    with tempfile.TemporaryDirectory() as folder, StopRequests() as stop:
        path, config = Path(folder) / 'messages.csv', Path(folder) / 'parameters.yaml'
        path.touch()
        write_config(Parameters(dict(given)), config)
        command = [sys.executable, '-m', 'backlash_ros.nodes.check_driver', '--drive',
                   '--messages', str(path), '--config', str(config)]
        for name in ('duration', 'wait', 'rest', 'amplitude', 'rate', 'output_range'):
            value = getattr(options, name)
            if value is not None:
                values = value if isinstance(value, list) else [value]
                command += [f'--{name.replace("_", "-")}', *map(str, values)]
        enough, sent = threading.Event(), 0
        threading.Thread(target=_look, args=(path, period, options, enough), daemon=True).start()
        # In a group of its own: Ctrl-C reaches only this process, which passes it on. At the first
        # one, or once enough is known, the node brings v to rest; at a second one it holds v.
        child = subprocess.Popen([*command, *ros_arguments], start_new_session=True,
                                 stdout=sys.stderr)
        while child.poll() is None:
            if max(stop.count, enough.is_set()) > sent:
                child.send_signal(signal.SIGINT)
                enough.set()
                sent += 1
            time.sleep(0.05)
        enough.set()
        record = _record(path, period)
        if child.returncode == BAD_INPUT:
            raise InputError('the actuator was not moved, see above')
        if stop.count:
            raise BrokenOffError('interrupted')
        if child.returncode or record is None:
            raise BrokenOffError('there is no record of a whole motion')
        return record


def _record(path: Path, period: float | None) -> Record | None:
    """The record of the messages that the node has written so far; None if there are too few.

    Each line of the file holds topic, stamp [ns] and value.
    """
    heard: dict[str, list[tuple[int, float]]] = {}
    *lines, _ = path.read_text(encoding='ascii').split('\n')  # the last may be incomplete
    for line in lines:
        topic, stamp, value = line.split(',')
        heard.setdefault(topic, []).append((int(stamp), float(value)))
    with suppress(RecordError):
        if len(heard.get(topics.PLANT_OUTPUT, ())) >= FEWEST_MESSAGES:
            return replace(from_messages(heard, period), source='the motion')
    return None


def _look(
    path: Path, period: float | None, options: argparse.Namespace, enough: threading.Event,
) -> None:
    """Identify the growing record now and then and print the result, until enough is known.

    Sets `enough` at --precision. It runs in a thread of lower priority than the driver.
    """
    def go_on(_: str) -> None:
        if enough.is_set():
            raise BrokenOffError('the estimate is no longer needed')

    os.nice(5)
    next_look = 3.0  # [s] of motion before an estimate
    while not enough.wait(0.25):
        # When the motion ends, the file is deleted as well.
        with suppress(BrokenOffError, FileNotFoundError):
            record = _record(path, period)
            moved = len(record.v) * record.sample_period if record else 0.0
            if record is None or moved < next_look:
                continue
            next_look *= 1.5
            found = identify_record(replace(record, commands=None), options, go_on)
            said = found.verdict.lines[0] if found.verdict else found.refused
            print(f'{moved:5.1f} s  {said}', file=sys.stderr, flush=True)
            if found.usable and max(found.std['gap'], found.gap * float(
                    found.model.response_std.max())) <= options.precision * found.gap:
                enough.set()
