"""From a measured record to the files of a result, the page, and what the terminal shows of it."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
from tqdm import tqdm

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimates_file import save_estimate
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import identify
from backlash_ros.core.identification.result import Details, Identification, Options
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import Value
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import BrokenOffError, format_table
from backlash_ros.tools.identify.identified_file import (
    alike,
    as_estimate,
    commented_yaml,
    hertz,
    identified_parameters,
    numbers,
)
from backlash_ros.tools.page import Picture, facts, page, table
from backlash_ros.tools.records.columns import COMMAND, ROLES
from backlash_ros.tools.runs.files import result_directory, write_summary, write_table

YAML, JSON, PAGE = 'identified.yaml', 'identified.json', 'identify.html'


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
            found = replace(found, reasons=(f'the controller does not take it: {error}',))
    write_summary({**numbers(found), 'timing': record.timing, 'notes': record.notes}, out / JSON)
    write_record(record, out / 'record.csv')
    # A Ctrl-C waits while Matplotlib is loaded, which would take it for a part that is missing.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    from backlash_ros.tools.identify.pictures import pictures
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    drawn = list(pictures(found))
    for picture in drawn:
        write_atomically(out / picture.name, picture.data)
    write_atomically(out / PAGE, _page(found, record, drawn, text))
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
            (name, f'{getattr(found, name):.6g}', f'{found.std[name]:.2g}')
            for name in ('gap', 'c_r', 'c_l')
        ]))
        integrator = ', one of them an integrator' if found.integrator else ''
        print(f'G(z): {len(found.denominator) - 1} poles{integrator}, delay {found.delay}'
              f'{alike(found)}, known to {100.0 * found.response_std.max():.2g} %; noise of y '
              f'{found.noise_std:.3g}')
    if found.actuator is not None:
        actuator = found.actuator
        print(f'L(z), from control to applied_control: {actuator.lag.order} poles, gain '
              f'{actuator.gain:.6g}; wind-up {actuator.wind_up[0]:.4g} on the right, '
              f'{actuator.wind_up[1]:.4g} on the left')
    print(f'time: {record.timing}')
    for text in (*record.notes, *found.remarks):
        print(f'note: {text}')
    for text in _other_reasons(found):
        print(f'no {YAML}: {text}')


def _other_reasons(found: Identification) -> list[str]:
    """Why it is of no use to a controller, but for what the verdict says."""
    said = () if found.verdict is None else found.verdict.reasons
    return [text for text in found.reasons if text not in said]


def _page(
    found: Identification, record: Record, pictures: Sequence[Picture], parameters: str | None,
) -> str:
    """The page as text. parameters: content of identified.yaml, None where there is none."""
    verdict = found.verdict
    known = verdict is not None and verdict.backlash.known
    lead = (
        f'<b>The backlash is {"" if known else "not "}known</b>: {len(found.y)} samples of '
        f'{found.sample_period:g} s from {escape(record.source)}.'
    )
    notes = (*(() if verdict is None else verdict.lines), *_other_reasons(found), *found.remarks,
             *record.notes)
    parts = [] if found.details is None else [
        _numbers(found) + _facts(found, found.details, record), _compared(found.details)]
    folded = None if parameters is None else ('identified.yaml', parameters)
    return page('Identification of backlash and G(z)', lead, notes, parts, pictures, folded)


def _numbers(found: Identification) -> str:
    return table(('', 'found', 'std. deviation', 'unit'), [
        (symbol, f'{getattr(found, name):.6g}', f'{found.std[name]:.2g}', unit)
        for name, symbol, unit in (
            ('gap', 'gap, c<sub>r</sub> − c<sub>l</sub>', 'of v'),
            ('c_r', 'c<sub>r</sub>', 'of v'), ('c_l', 'c<sub>l</sub>', 'of v'),
            ('m', 'm (told, or 1; deviation: of the gain of m G)', 'of u/v'),
        )
    ])


def _facts(found: Identification, details: Details, record: Record) -> str:
    band, held_out = hertz(found), details.held_out
    quantum = f', steps of {found.quantum:.3g}' if found.quantum else ''
    return facts([
        ('time', escape(record.timing)),
        ('numerator of G', _listed(found.numerator)),
        ('denominator of G', _listed(found.denominator)),
        ('poles', ', '.join(
            f'{pole.real:.5g}' + (f' {pole.imag:+.5g} i' if abs(pole.imag) >= 1e-9 else '')
            for pole in np.roots(found.denominator))),
        ('delay', f'{found.delay} samples{alike(found)}'),
        ('G is known to', f'{100.0 * found.response_std.max():.2g} %, {band[0]:.2g} to '
                          f'{band[-1]:.2g} Hz'),
        ('noise of y', f'{found.noise_std:.3g}{quantum}'),
        ('error on samples held out', f'{held_out.rms:.3g} (fit: {held_out.trained:.3g})'),
        ('correlation of the residual', f'{found.correlation:.2g} from sample to sample'),
        ('lost samples, outliers', f'{record.lost}, {found.outliers}'),
    ], columns=1)


def _compared(details: Details) -> str:
    """The best of each order, with and without an integrator."""
    kinds = sorted({(one.structure.order, one.structure.integrator) for one in details.compared})
    rows = []
    for order, integrator in kinds:
        best = min((one for one in details.compared if one.structure.order == order
                    and one.structure.integrator == integrator), key=lambda one: one.held_out)
        taken = best.structure == details.chosen.structure
        rows.append((
            f'{order} pole{"s" * (order != 1)}' + ', one an integrator' * integrator
            + ' (taken)' * taken, str(best.structure.delay), f'{best.held_out:.4g}',
        ))
    return '<h2>Orders compared</h2>' + table(
        ('G', 'delay [samples]', 'error on samples held out'), rows)


def _listed(values: Sequence[float]) -> str:
    return ', '.join(f'{value:.6g}' for value in values)
