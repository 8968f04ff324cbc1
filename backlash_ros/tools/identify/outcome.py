"""From a measured record to the files of a result and what the terminal shows of it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Generator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimates_file import save_estimate
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import (
    Identification,
    Options,
    identifying,
)
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import Value
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import BrokenOffError, format_table
from backlash_ros.tools.identify.identified_file import (
    alike,
    as_estimate,
    commented_yaml,
    identified_parameters,
    numbers,
)
from backlash_ros.tools.records.columns import COMMAND, ROLES
from backlash_ros.tools.runs.files import result_directory, write_summary, write_table

YAML, JSON, PAGE, ESTIMATES = (
    'identified.yaml', 'identified.json', 'identify.html', 'estimates.json')
INTEGRATORS = {'auto': (False, True), 'yes': (True,), 'no': (False,)}


def identifying_record(
    record: Record, options: argparse.Namespace,
) -> Generator[str, None, Identification]:
    """Identify with what the command line says; yields what is being done."""
    found = yield from identifying(record.v, record.y, record.sample_period, Options(
        options.order, options.delay, INTEGRATORS[options.integrator], options.slope,
    ))
    return found if record.commands is None else with_actuator(found, record.commands)


def identified(record: Record, options: argparse.Namespace) -> Identification:
    """Identify, with a bar on a terminal; raises BrokenOffError."""
    work = identifying_record(record, options)
    with tqdm(file=sys.stderr, disable=None, leave=False, bar_format='{desc}: {elapsed}') as bar:
        while True:
            try:
                bar.set_description_str(next(work))
            except StopIteration as done:
                found: Identification = done.value
                return found
            except np.linalg.LinAlgError as error:
                raise BrokenOffError(f'the record cannot be fitted: {error}') from error


def write_outcome(
    found: Identification, record: Record, given: Mapping[str, Value],
    options: argparse.Namespace,
) -> bool:
    """Write the files, print the outcome; returns whether the backlash is known."""
    out = result_directory(options.out)
    text = None
    if found.usable:
        (out / ESTIMATES).unlink(missing_ok=True)  # of a record before, if any
        try:
            parameters = identified_parameters(found, given, out.resolve() / ESTIMATES)
            text = commented_yaml(parameters, found, record.source, options.axis)
            write_atomically(out / YAML, text)
            save_estimate(out / ESTIMATES, as_estimate(found, parameters), parameters)
        except ParameterError as error:
            found = replace(found, reasons=(f'the controller does not take it: {error}',))
    write_summary({**numbers(found), 'timing': record.timing, 'notes': record.notes}, out / JSON)
    write_record(record, out / 'record.csv')
    # Matplotlib is loaded where there is something to draw.
    from backlash_ros.tools.identify.page import render
    from backlash_ros.tools.identify.pictures import pictures
    drawn = list(pictures(found))
    for picture in drawn:
        write_atomically(out / picture.name, picture.data)
    write_atomically(out / PAGE, render(found, record, drawn, text))
    _print(found, record)
    print(out / (YAML if found.usable else JSON))
    print(out / PAGE)
    return found.verdict is not None and found.verdict.backlash.known


def write_record(record: Record, path: Path) -> None:
    """Write t, v, y, and the commands where they are others, as a CSV that `identify` reads."""
    t = record.sample_period * np.arange(len(record.v))
    commands = [] if record.commands is None else [record.commands]
    rows = np.column_stack([t, record.v, record.y, *commands]).tolist()
    write_table(path, (*ROLES, COMMAND)[:3 + len(commands)], rows)


def _print(found: Identification, record: Record) -> None:
    if found.verdict is not None:
        print('\n'.join(found.verdict.lines))
    if found.details is not None:
        print(format_table(('', 'found', '±'), [
            (name, f'{value:.6g}', f'{found.std[name]:.2g}')
            for name, value in (('gap', found.gap), ('c_r', found.c_r), ('c_l', found.c_l))
        ]))
        print(f'G(z): {len(found.denominator) - 1} poles'
              + (', one of them an integrator' if found.integrator else '')
              + f', delay {found.delay}{alike(found)}'
              + f', known to {found.response_std.max():.2g} of itself; noise of y '
              + f'{found.noise_std:.3g}')
    if found.actuator is not None:
        actuator = found.actuator
        print(f'L(z), from control to applied_control: {actuator.lag.order} poles, gain '
              f'{actuator.gain:.6g}; wind-up {actuator.wind_up[0]:.4g} on the right, '
              f'{actuator.wind_up[1]:.4g} on the left')
    print(f'time: {record.timing}')
    for text in (*record.notes, *found.remarks):
        print(f'note: {text}')
    for text in found.reasons:
        # That the backlash is not known stands in the first lines.
        if found.verdict is None or found.verdict.backlash.known:
            print(f'no {YAML}: {text}')
