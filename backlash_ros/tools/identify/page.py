"""identify.html: what was found, how surely, and the pictures, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from math import isfinite

import numpy as np

from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import NOTHING
from backlash_ros.tools.identify.identified_file import alike, hertz
from backlash_ros.tools.page import Picture, facts, page, table


def render(
    found: Identification, record: Record, pictures: Sequence[Picture], parameters: str | None,
) -> str:
    """The page as text. parameters: content of identified.yaml, None where there is none."""
    verdict = found.verdict
    known = verdict is not None and verdict.backlash.known
    lead = (
        f'<b>The backlash is {"" if known else "not "}known</b>: {len(found.y)} samples of '
        f'{found.sample_period:g} s from {escape(record.source)}.'
    )
    notes = (*(() if verdict is None else verdict.lines), *found.reasons, *found.remarks,
             *record.notes)
    parts = [] if found.details is None else [
        _numbers(found) + _facts(found, record), _compared(found.details)]
    folded = None if parameters is None else ('identified.yaml', parameters)
    return page('Identification of backlash and G(z)', lead, notes, parts, pictures, folded)


def _numbers(found: Identification) -> str:
    rows = [
        (symbol, f'{value:.6g}', f'{found.std[name]:.2g}', unit)
        for name, symbol, value, unit in (
            ('gap', 'gap, c<sub>r</sub> − c<sub>l</sub>', found.gap, 'of v'),
            ('c_r', 'c<sub>r</sub>', found.c_r, 'of v'),
            ('c_l', 'c<sub>l</sub>', found.c_l, 'of v'),
            ('m', 'm (told, or 1; deviation: of the gain of m G)', found.m, 'of u/v'),
        )
    ]
    return table(('', 'found', 'std. deviation', 'unit'), rows)


def _facts(found: Identification, record: Record) -> str:
    band = hertz(found)
    held_out = found.details and found.details.held_out
    quantum = f', steps of {found.quantum:.3g}' if found.quantum else ''
    return facts([
        ('time', escape(record.timing)),
        ('numerator of G', _listed(found.numerator)),
        ('denominator of G', _listed(found.denominator)),
        ('poles', ', '.join(
            f'{pole.real:.5g}' + (f' {pole.imag:+.5g} i' if abs(pole.imag) >= 1e-9 else '')
            for pole in np.roots(found.denominator))),
        ('delay', f'{found.delay} samples{alike(found)}'),
        ('G is known to', f'{found.response_std.max():.2g} of itself, {band[0]:.2g} to '
                          f'{band[-1]:.2g} Hz'),
        ('noise of y', f'{found.noise_std:.3g}{quantum}'),
        ('error on samples held out', NOTHING if held_out is None else
         f'{held_out.rms:.3g} (fit: {held_out.trained:.3g})'),
        ('correlation of the residual', f'{found.correlation:.2g} from sample to sample'
         if isfinite(found.correlation) else NOTHING),
        ('lost samples, outliers', f'{record.lost}, {found.outliers}'),
    ], columns=1)


def _compared(details: Details) -> str:
    """The best of each order, with and without an integrator."""
    kinds = sorted({(one.structure.order, one.structure.integrator) for one in details.compared})
    rows = []
    for order, integrator in kinds:
        best = min((one for one in details.compared if one.structure.order == order
                    and one.structure.integrator == integrator), key=lambda one: one.held_out)
        taken = best.structure[:3] == details.chosen.structure[:3]
        rows.append((
            f'{order} pole{"s" * (order != 1)}' + ', one an integrator' * integrator
            + ' (taken)' * taken, str(best.structure.delay), f'{best.held_out:.4g}',
        ))
    return '<h2>Orders compared</h2>' + table(
        ('G', 'delay [samples]', 'error on samples held out'), rows)


def _listed(values: Sequence[float]) -> str:
    return ', '.join(f'{value:.6g}' for value in values)
