"""From a measured record to the files of a result, the page, and what the terminal shows of it."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Mapping
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimates_file import save_estimate
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.identification.structure_search import Options
from backlash_ros.core.parameters import ParameterError, Value
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import BrokenOffError, format_table
from backlash_ros.tools.identify import identified_file as file
from backlash_ros.tools.page import facts, page, table
from backlash_ros.tools.records.columns import COMMAND, ROLES
from backlash_ros.tools.runs.files import result_directory, write_summary, write_table

YAML = 'identified.yaml'


def identify_record(record: Record, options: argparse.Namespace) -> Identification:
    """Identify with what the command line says; raises BrokenOffError."""
    integrators = {'auto': (False, True), 'yes': (True,), 'no': (False,)}[options.integrator]
    try:
        found = identify(record.v, record.y, record.sample_period, Options(
            options.order, options.delay, integrators, options.slope))
        return found if record.commands is None else with_actuator(found, record.commands)
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
            parameters = file.identified_parameters(found, given, estimates)
            text = file.commented_yaml(parameters, found, record.source, options.axis)
            write_atomically(out / YAML, text)
            save_estimate(estimates, file.as_estimate(found, parameters), parameters)
        except ParameterError as error:
            found = replace(found, refused=f'the controller does not take it: {error}')
    write_summary({**file.numbers(found), 'timing': record.timing, 'notes': record.notes},
                  out / 'identified.json')
    write_record(replace(record, v=found.v), out / 'record.csv')
    # A Ctrl-C waits while Matplotlib is loaded, which would take it for a part that is missing.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    from backlash_ros.tools.identify.pictures import pictures
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    drawn = list(pictures(found))
    for picture in drawn:
        write_atomically(out / picture.name, picture.data)

    known = found.verdict is not None and found.verdict.backlash.known
    lines = found.verdict.lines if found.verdict else ()
    refused = [f'no {YAML}: {found.refused}'] if found.refused else []
    notes = [*record.notes, *found.remarks]
    constants = [(name, f'{getattr(found, name):.6g}', f'{found.std[name]:.2g}')
                 for name in ('gap', 'c_r', 'c_l', 'm') if found.std]
    head, told = ('', 'found', '±'), _facts(found, record)
    write_atomically(out / 'identify.html', page(
        'Identification of backlash and G(z)',
        f'<b>The backlash is {"" if known else "not "}known</b>: {len(found.y)} samples of '
        f'{found.sample_period:g} s from {escape(record.source)}.', [*lines, *refused, *notes],
        [table(head, constants) + facts([(name, escape(fact)) for name, fact in told], 1)]
        if constants else [], drawn, None if text is None else (YAML, text)))
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
    g = found.model
    told = [('time', record.timing), ('lost samples, outliers', f'{record.lost}, {g.outliers}')]
    if found.details is not None:
        band, held_out = found.hertz, found.details.held_out
        alike = f' ({g.delays[0]} to {g.delays[-1]} fit alike)' if len(g.delays) > 1 else ''
        told += [
            ('G(z)', f'{len(g.denominator) - 1} poles{", one of them an integrator" * g.integrator}'
                     f', delay {g.delay}{alike}, known to {100.0 * g.response_std.max():.2g} % '
                     f'from {band[0]:.2g} to {band[-1]:.2g} Hz'),
            ('poles', ', '.join(f'{pole:.5g}' for pole in np.roots(g.denominator).tolist())),
            ('noise of y', f'{g.noise_std:.3g}'
                           + (f', steps of {g.quantum:.3g}' if g.quantum else '')),
            ('error on samples held out', f'{held_out.rms:.3g} (fit: {held_out.trained:.3g})')]
    if (actuator := found.actuator) is not None:
        right, left = actuator.wind_up
        told.append(('L(z), from control to applied_control',
                     f'{actuator.lag.order} poles, gain {actuator.gain:.6g}; wind-up {right:.4g} '
                     f'on the right, {left:.4g} on the left'))
    return told
