"""`identify --drive`: lets a node move the actuator, and looks at the record as it grows."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path

from tqdm import tqdm

from backlash_ros import topics
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.parameter_table import Value
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.configuration import write_config
from backlash_ros.tools.errors import BrokenOffError, InputError
from backlash_ros.tools.identify.measured_record import MeasuredRecord, by_topic, from_messages
from backlash_ros.tools.identify.outcome import options_of
from backlash_ros.tools.supervision import StopRequests

NODE = 'backlash_ros.nodes.identification_drive'
LOOK_S = 0.2  # between two looks at the record
FIRST_LOOK_S = 3.0  # of motion before the first estimate
SHARE_OF_TIME = 0.25  # of the time that estimates may take: the actuator needs the processor
REPORTED = 0.9  # share of the samples that applied_control has to report to be believed
KINDER = 5  # by which this process gives way to the driver and to what moves it
BAD_INPUT = 2


def drive(
    options: argparse.Namespace, given: Mapping[str, Value], ros_arguments: Sequence[str],
) -> MeasuredRecord:
    """Move the actuator and return the record.

    Raises InputError where it was refused, BrokenOffError where it was interrupted or nothing came.
    """
    with tempfile.TemporaryDirectory() as folder, StopRequests() as stop:
        messages, config = Path(folder) / 'messages.csv', Path(folder) / 'parameters.yaml'
        messages.touch()
        write_config(Parameters(dict(given)), config)
        os.nice(KINDER)
        # A group of its own: a Ctrl-C reaches this process alone, which passes it on.
        child = subprocess.Popen(
            [sys.executable, '-m', NODE, *_arguments(options, messages, config), *ros_arguments],
            start_new_session=True, stdout=sys.stderr, preexec_fn=_as_before,
        )
        try:
            _follow(child, messages, options, given, stop)
        finally:
            _end(child, stop)
        if child.returncode == BAD_INPUT:
            raise InputError('the actuator was not moved, see above')
        record = _record(messages, given)
        if stop.count:
            raise BrokenOffError('interrupted; v was brought to rest')
        if child.returncode or record is None:
            raise BrokenOffError('there is no record of a motion')
        return record


def _as_before() -> None:
    os.nice(-KINDER if os.geteuid() == 0 else 0)


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
    child: subprocess.Popen[bytes], messages: Path, options: argparse.Namespace,
    given: Mapping[str, Value], stop: StopRequests,
) -> None:
    """Show progress until the motion ends, is precise enough, or is to be stopped."""
    next_look, told = FIRST_LOOK_S, ''
    with tqdm(
        total=options.duration, file=sys.stderr, disable=None, leave=False,
        bar_format='{desc} {percentage:3.0f} % |{bar:16}| {postfix}', desc='moving',
    ) as bar:
        while child.poll() is None and not stop.count:
            time.sleep(LOOK_S)
            record = _record(messages, given)
            if record is None:
                continue
            moved = len(record.v) * record.sample_period
            bar.n = min(moved, options.duration)
            bar.set_postfix_str(told)
            if moved < next_look:
                continue
            started = time.monotonic()
            found = identify(record.v, record.y, record.sample_period, options_of(options))
            took = time.monotonic() - started
            next_look = moved + max(took / SHARE_OF_TIME, 1.0)
            told = _told(found)
            line = f'{moved:5.1f} s  {told}'
            if bar.disable:
                print(line, file=sys.stderr, flush=True)
            else:
                bar.write(line, file=sys.stderr)
            if _precise(found, options.precision):
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


def _record(messages: Path, given: Mapping[str, Value]) -> MeasuredRecord | None:
    """What was written so far, None while it is no record yet."""
    rows = []
    for line in messages.read_text(encoding='ascii').split('\n')[:-1]:
        topic, stamp, value = line.split(',')
        rows.append((topic, int(stamp), float(value)))
    heard = by_topic(rows)
    output = heard.get(topics.PLANT_OUTPUT)
    commands = heard.get(topics.APPLIED_CONTROL)
    if output is None or len(output[0]) < 3:
        return None
    if commands is None or len(commands[0]) < REPORTED * len(output[0]):
        commands = heard.get(topics.CONTROL)
    if commands is None:
        return None
    period = given.get('sample_period')
    try:
        return from_messages(
            Path('the motion'), output, commands, period if isinstance(period, float) else None
        )
    except InputError:
        return None
