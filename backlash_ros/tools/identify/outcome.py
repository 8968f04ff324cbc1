"""From a measured record to the files of a result, the page, and what the terminal shows of it."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
from tqdm import tqdm

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimates_file import save_estimate
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import identify
from backlash_ros.core.identification.result import Identification, Options
from backlash_ros.core.parameters import ParameterError, Value
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import BrokenOffError, format_table
from backlash_ros.tools.identify.identified_file import (
    as_estimate,
    commented_yaml,
    hertz,
    identified_parameters,
    numbers,
)
from backlash_ros.tools.page import facts, page, table
from backlash_ros.tools.records.columns import COMMAND, ROLES
from backlash_ros.tools.runs.files import result_directory, write_summary, write_table

YAML = 'identified.yaml'


def identify_record(
    record: Record, options: argparse.Namespace, progress: Callable[[str], object],
) -> Identification:
    """Identify with what the command line says. progress: is told what is being done."""
    integrators = {'auto': (False, True), 'yes': (True,), 'no': (False,)}[options.integrator]
    found = identify(record.v, record.y, record.sample_period, Options(
        options.order, options.delay, integrators, options.slope), progress)
    return found if record.commands is None else with_actuator(found, record.commands)


def identified(record: Record, options: argparse.Namespace) -> Identification:
    """Identify, with a bar on a terminal; raises BrokenOffError."""
    with tqdm(file=sys.stderr, disable=None, leave=False, bar_format='{desc}: {elapsed}') as bar:
        try:
            return identify_record(record, options, bar.set_description_str)
        except np.linalg.LinAlgError as error:
            raise BrokenOffError(f'the record cannot be fitted: {error}') from error


def write_outcome(
    found: Identification, record: Record, given: Mapping[str, Value],
    options: argparse.Namespace,
) -> bool:
    """Write the files, print the outcome; returns whether the backlash is known."""
    out = result_directory(options.out)
    estimates, text = out.resolve() / 'estimates.json', None
    if found.usable:
        estimates.unlink(missing_ok=True)  # of a record before, if any
        try:
            parameters = identified_parameters(found, given, estimates)
            text = commented_yaml(parameters, found, record.source, options.axis)
            write_atomically(out / YAML, text)
            save_estimate(estimates, as_estimate(found, parameters), parameters)
        except ParameterError as error:
            found = replace(found, refused=f'the controller does not take it: {error}')
    write_summary({**numbers(found), 'timing': record.timing, 'notes': record.notes},
                  out / 'identified.json')
    write_record(replace(record, v=found.v), out / 'record.csv')
    # A Ctrl-C waits while Matplotlib is loaded, which would take it for a part that is missing.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    from backlash_ros.tools.identify.pictures import pictures
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    drawn = list(pictures(found))
    for picture in drawn:
        write_atomically(out / picture.name, picture.data)

    verdict, details = found.verdict, found.details
    known = verdict is not None and verdict.backlash.known
    lines, said = ((), ()) if verdict is None else (verdict.lines, verdict.reasons)
    refused = [f'no {YAML}: {text}' for text in found.reasons if text not in said]
    notes = [*record.notes, *found.remarks]
    constants = [] if details is None else [
        (name, f'{getattr(found, name):.6g}', f'{found.std[name]:.2g}')
        for name in ('gap', 'c_r', 'c_l', 'm')]
    head, told = ('', 'found', '±'), _facts(found, record)
    write_atomically(out / 'identify.html', page(
        'Identification of backlash and G(z)',
        f'<b>The backlash is {"" if known else "not "}known</b>: {len(found.y)} samples of '
        f'{found.sample_period:g} s from {escape(record.source)}.', [*lines, *refused, *notes],
        [] if details is None else [
            table(head, constants) + facts([(name, escape(fact)) for name, fact in told], 1)],
        drawn, None if text is None else (YAML, text)))
    print('\n'.join([
        *lines, *([format_table(head, constants)] if constants else []),
        *(f'{name}: {fact}' for name, fact in told), *(f'note: {note}' for note in notes), *refused,
        str(out / (YAML if found.usable else 'identified.json')), str(out / 'identify.html')]))
    return known


def write_record(record: Record, path: Path) -> None:
    """Write t, v, y, and the commands where they are others, as a CSV that `identify` reads."""
    columns = [record.sample_period * np.arange(len(record.v)), record.v, record.y, record.commands]
    rows = np.column_stack([values for values in columns if values is not None]).tolist()
    write_table(path, (*ROLES, COMMAND)[:len(rows[0])], rows)


def _facts(found: Identification, record: Record) -> list[tuple[str, str]]:
    """What was found besides the backlash, by name, for the terminal and the page."""
    g, noise = found.model, found.noise
    told = [('time', record.timing), ('lost samples, outliers', f'{record.lost}, {noise.outliers}')]
    if found.details is not None:
        band, held_out = hertz(found), found.details.held_out
        alike = f' ({g.delays[0]} to {g.delays[-1]} fit alike)' if len(g.delays) > 1 else ''
        told += [
            ('G(z)', f'{len(g.denominator) - 1} poles{", one of them an integrator" * g.integrator}'
                     f', delay {g.delay}{alike}, known to {100.0 * g.response_std.max():.2g} % '
                     f'from {band[0]:.2g} to {band[-1]:.2g} Hz'),
            ('poles', ', '.join(f'{pole:.5g}' for pole in np.roots(g.denominator).tolist())),
            ('noise of y', f'{noise.std:.3g}'
                           + (f', steps of {noise.quantum:.3g}' if noise.quantum else '')),
            ('error on samples held out', f'{held_out.rms:.3g} (fit: {held_out.trained:.3g})')]
    if (actuator := found.actuator) is not None:
        told.append(('L(z), from control to applied_control',
                     f'{actuator.lag.order} poles, gain {actuator.gain:.6g}; wind-up '
                     f'{actuator.wind_up[0]:.4g} on the right, {actuator.wind_up[1]:.4g} on the '
                     'left'))
    return told
