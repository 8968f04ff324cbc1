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
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
from tqdm import tqdm

from backlash_ros import topics
from backlash_ros.core.identification.identification import (
    Identification,
    Options,
    identifying,
)
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.parameter import Value
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.middleware.installed import ROS_MISSING, ros_is_missing
from backlash_ros.options import BAD_INPUT
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests
from backlash_ros.tools.config import write_config
from backlash_ros.tools.identify.outcome import options_of
from backlash_ros.tools.records.messages import from_messages

NODE = 'backlash_ros.nodes.identification_drive'
LOOK_S = 0.25  # between two looks at the record
FEWEST = 3  # samples that are a record
FIRST_LOOK_S = 3.0  # of motion before the first estimate
SHARE_OF_TIME = 0.25  # of the time that estimates may take: the actuator needs the processor


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
        messages = _Messages(path)
        period = given.get('sample_period')
        period_s = period if isinstance(period, float) else None
        write_config(Parameters(dict(given)), config)
        # A group of its own: a Ctrl-C reaches this process alone, which passes it on.
        child = subprocess.Popen(
            [sys.executable, '-m', NODE, *_arguments(options, path, config), *ros_arguments],
            start_new_session=True, stdout=sys.stderr,
        )
        try:
            _follow(child, messages, options, period_s, stop)
        finally:
            _end(child, stop)
            record = messages.record(period_s)
            messages.close()
        if child.returncode == BAD_INPUT:
            raise InputError('the actuator was not moved, see above')
        if stop.count:
            raise BrokenOffError('interrupted; v was brought to rest')
        if child.returncode or record is None:
            raise BrokenOffError('there is no record of a motion')
        return record


def _arguments(options: argparse.Namespace, messages: Path, config: Path) -> list[str]:
    given = [
        '--messages', str(messages), '--config', str(config),
        '--duration', str(options.duration), '--wait', str(options.wait),
        '--rest', str(options.rest),
    ]
    for name in ('amplitude', 'rate'):
        value = getattr(options, name)
        given += [] if value is None else [f'--{name}', str(value)]
    if options.output_range is not None:
        given += ['--output-range', *map(str, options.output_range)]
    return given


def _follow(
    child: subprocess.Popen[bytes], messages: _Messages, options: argparse.Namespace,
    sample_period: float | None, stop: StopRequests,
) -> None:
    """Show progress until the motion ends, is precise enough, or is to be stopped."""
    next_look, told = FIRST_LOOK_S, ''
    estimate: _Estimate | None = None
    with tqdm(
        total=options.duration, file=sys.stderr, disable=None, leave=False,
        bar_format='{desc} {percentage:3.0f} % |{bar:16}| {postfix}', desc='moving',
    ) as bar:
        while child.poll() is None and not stop.count:
            time.sleep(LOOK_S)
            record = messages.record(sample_period)
            if record is None:
                continue
            moved = len(record.v) * record.sample_period
            bar.n = min(moved, options.duration)
            bar.set_postfix_str(told)
            if estimate is None and moved >= next_look:
                estimate = _Estimate(record, options_of(options))
            if estimate is None or estimate.found is None:
                continue
            found, told = estimate.found, _told(estimate.found)
            next_look, estimate = moved + max(estimate.took_s / SHARE_OF_TIME, 1.0), None
            line = f'{moved:5.1f} s  {told}'
            if bar.disable:
                print(line, file=sys.stderr, flush=True)
            else:
                bar.write(line, file=sys.stderr)
            if _precise(found, options.precision):
                break
    if estimate is not None:
        estimate.give_up()


class _Estimate:
    """What a record says, looked for beside the motion by a thread that gives way to it.

    found: None until it is known. took_s: how long that was looked for.
    """

    def __init__(self, record: Record, options: Options) -> None:
        self.found: Identification | None = None
        self.took_s = 0.0
        self._work = identifying(record.v, record.y, record.sample_period, options)
        self._given_up = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def give_up(self) -> None:
        """End the search without a result."""
        self._given_up.set()
        self._thread.join()

    def _look(self) -> None:
        if sys.platform == 'linux':
            os.nice(5)  # this thread alone gives way to the driver and to what moves it
        started = time.monotonic()
        while not self._given_up.is_set():
            try:
                next(self._work)
            except StopIteration as done:
                self.took_s = time.monotonic() - started
                self.found = done.value
                return


def _told(found: Identification) -> str:
    if found.details is None:
        return found.reasons[0]
    return (
        f'gap {found.gap:.4g} ± {found.std["gap"]:.1g}, c_r {found.c_r:.4g} ± '
        f'{found.std["c_r"]:.1g}, G ± {found.response_std.max():.1%}'
    )


def _precise(found: Identification, precision: float) -> bool:
    return found.usable and precision > 0.0 and max(
        found.std['gap'] / found.gap if found.gap > 0.0 else inf,
        float(found.response_std.max()),
    ) <= precision


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


class _Messages:
    """What the node has written so far: topic, stamp [ns], value on each line."""

    def __init__(self, path: Path) -> None:
        self._file = path.open(encoding='ascii')
        self._unfinished = ''
        self._heard: dict[str, tuple[list[int], list[float]]] = {}

    def close(self) -> None:
        self._file.close()

    def record(self, sample_period: float | None) -> Record | None:
        """The record, None while it is none yet."""
        *lines, self._unfinished = (self._unfinished + self._file.read()).split('\n')
        for line in lines:
            topic, stamp, value = line.split(',')
            stamps, values = self._heard.setdefault(topic, ([], []))
            stamps.append(int(stamp))
            values.append(float(value))
        heard = {
            topic: (np.array(stamps, dtype=np.int64), np.array(values))
            for topic, (stamps, values) in self._heard.items()
        }
        output = heard.get(topics.PLANT_OUTPUT)
        if output is None or len(output[0]) < FEWEST:
            return None
        try:
            return replace(from_messages(heard, sample_period), source='the motion')
        except RecordError:
            return None
