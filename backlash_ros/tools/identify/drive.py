"""`identify --drive`: lets a node move the actuator, and looks at the record as it grows."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np
from tqdm import tqdm

from backlash_ros import topics
from backlash_ros.core.identification.result import Identification
from backlash_ros.core.parameters import Parameters, Value
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.middleware import ROS_MISSING, ros_is_missing
from backlash_ros.options import BAD_INPUT
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests
from backlash_ros.tools.config import write_config
from backlash_ros.tools.identify.outcome import identify_record
from backlash_ros.tools.records.messages import FEWEST_MESSAGES, as_messages, from_messages


def drive(
    options: argparse.Namespace, given: Mapping[str, Value], ros_arguments: Sequence[str],
) -> Record:
    """Move the actuator and return the record.

    Raises InputError where it was refused, BrokenOffError where it was interrupted, where nothing
    came, or without ROS 2.
    """
    if ros_is_missing():
        raise BrokenOffError(ROS_MISSING)
    with tempfile.TemporaryDirectory() as folder, StopRequests() as stop:
        path, config = Path(folder) / 'messages.csv', Path(folder) / 'parameters.yaml'
        path.touch()
        period = given.get('sample_period')
        write_config(Parameters(dict(given)), config)
        command = [
            sys.executable, '-m', 'backlash_ros.nodes.drive',
            '--messages', str(path), '--config', str(config),
        ]
        for name in ('duration', 'wait', 'rest', 'amplitude', 'rate', 'output_range'):
            value = getattr(options, name)
            if value is not None:
                values = value if isinstance(value, list) else [value]
                command += [f'--{name.replace("_", "-")}', *map(str, values)]
        with path.open(encoding='ascii') as file:
            messages = _Messages(file, period if isinstance(period, float) else None)
            # A group of its own: a Ctrl-C reaches this process alone, which passes it on.
            child = subprocess.Popen([*command, *ros_arguments], start_new_session=True,
                                     stdout=sys.stderr)
            try:
                _follow(child, messages, options, stop)
            finally:
                _end(child, stop)
            record = messages.record()
        if child.returncode == BAD_INPUT:
            raise InputError('the actuator was not moved, see above')
        if stop.count:
            raise BrokenOffError('interrupted; v was brought to rest')
        if child.returncode or record is None:
            raise BrokenOffError('there is no record of a motion')
        return record


class _Messages:
    """What the node has written so far: topic, stamp [ns], value on each line."""

    def __init__(self, file: TextIO, period: float | None) -> None:
        self._file, self._period, self._unfinished = file, period, ''
        self._heard: dict[str, list[tuple[int, float]]] = {}

    def record(self) -> Record | None:
        """The record, None while it is none yet."""
        *lines, self._unfinished = (self._unfinished + self._file.read()).split('\n')
        for line in lines:
            topic, stamp, value = line.split(',')
            self._heard.setdefault(topic, []).append((int(stamp), float(value)))
        if len(self._heard.get(topics.PLANT_OUTPUT, ())) < FEWEST_MESSAGES:
            return None
        with suppress(RecordError):
            return replace(from_messages({topic: as_messages(pairs) for topic, pairs in
                                          self._heard.items()}, self._period), source='the motion')
        return None


class _GivenUpError(Exception):
    """Nobody asks for the estimate any more."""


def _follow(
    child: subprocess.Popen[bytes], messages: _Messages, options: argparse.Namespace,
    stop: StopRequests,
) -> None:
    """Show progress until the motion ends, is precise enough, or is to be stopped.

    What the record says is looked for beside the motion, by a thread that gives way to the driver.
    """
    next_look, said = 3.0, ''  # [s] of motion before an estimate
    given_up = threading.Event()

    def look(record: Record) -> Identification | None:
        with suppress(_GivenUpError, np.linalg.LinAlgError):
            return identify_record(replace(record, commands=None), options, go_on)
        return None

    def go_on(_: str) -> None:
        if given_up.is_set():
            raise _GivenUpError

    estimate: Future[Identification | None] | None = None
    beside = ThreadPoolExecutor(1, initializer=partial(os.nice, 5 * (sys.platform == 'linux')))
    with tqdm(
        total=options.duration, file=sys.stderr, disable=None, leave=False,
        bar_format='{desc} {percentage:3.0f} % |{bar:16}| {postfix}', desc='moving',
    ) as bar:
        while child.poll() is None and not stop.count:
            time.sleep(0.25)
            record = messages.record()
            if record is None:
                continue
            moved = len(record.v) * record.sample_period
            bar.n = min(moved, options.duration)
            bar.set_postfix_str(said)
            if estimate is None and moved >= next_look:
                estimate = beside.submit(look, record)
            if estimate is None or not estimate.done():
                continue
            found, estimate, next_look = estimate.result(), None, 1.5 * next_look
            if found is None:
                continue
            said = _said(found)
            line = f'{moved:5.1f} s  {said}'
            if bar.disable:
                print(line, file=sys.stderr, flush=True)
            else:
                bar.write(line, file=sys.stderr)
            if found.usable and max(found.std['gap'], found.gap * float(
                    found.model.response_std.max())) <= options.precision * found.gap:
                break
    # Without waiting for it: the node is to come to rest now.
    given_up.set()
    beside.shutdown(wait=False)


def _said(found: Identification) -> str:
    if found.details is None:
        return found.reasons[0]
    return (
        f'gap {found.gap:.4g} ± {found.std["gap"]:.1g}, c_r {found.c_r:.4g} ± '
        f'{found.std["c_r"]:.1g}, G ± {found.model.response_std.max():.1%}'
    )


def _end(child: subprocess.Popen[bytes], stop: StopRequests) -> None:
    """Let the node come to rest; every further signal is passed on: it then holds v."""
    if child.poll() is None:
        child.send_signal(signal.SIGINT)
    passed = stop.count
    while child.poll() is None:
        time.sleep(0.05)
        if stop.count > max(passed, 1):
            passed = stop.count
            child.send_signal(signal.SIGINT)
