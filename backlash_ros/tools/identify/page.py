"""identify.html: what was found, how surely, and the pictures, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from math import isfinite

import numpy as np

from backlash_ros.core.identification.identification import Identification
from backlash_ros.tools.cli import NOTHING
from backlash_ros.tools.page import Picture, facts, page, table

TITLE = 'Identification of backlash and G(z)'


def render(
    found: Identification, source: str, pictures: Sequence[Picture], parameters: str | None,
) -> str:
    """The page as text. parameters: content of identified.yaml, None where there is none."""
    parts = [] if found.details is None else [_numbers(found) + _facts(found)]
    folded = None if parameters is None else ('identified.yaml', parameters)
    lines = () if found.verdict is None else found.verdict.lines
    warnings = (*lines, *found.reasons, *found.remarks)
    return page(TITLE, _headline(found, source), warnings, parts, pictures, folded)


def _headline(found: Identification, source: str) -> str:
    about = f'{len(found.y)} samples of {found.sample_period:g} s from {escape(source)}'
    known = found.verdict is not None and found.verdict.backlash.known
    return f'<b>{"The backlash is known" if known else "The backlash is not known"}</b>: {about}.'


def _numbers(found: Identification) -> str:
    rows = [
        (symbol, f'{value:.6g}', f'{found.std[name]:.2g}', unit)
        for name, symbol, value, unit in (
            ('gap', 'gap', found.gap, 'of v'),
            ('c_r', 'c<sub>r</sub>', found.c_r, 'of v'),
            ('c_l', 'c<sub>l</sub>', found.c_l, 'of v'),
            ('m', 'm (told, or 1; deviation: of the gain of m G)', found.m, 'of u/v'),
        )
    ]
    return table(('', 'found', 'std. deviation', 'unit'), rows)


def _facts(found: Identification) -> str:
    poles = np.roots(found.denominator)
    hertz = found.frequencies / (2.0 * np.pi * found.sample_period)
    delays = ' (' + ', '.join(map(str, found.delays)) + ' fit alike)' \
        if len(found.delays) > 1 else ''
    held = found.details.held_out if found.details else None
    return facts([
        ('numerator of G', ', '.join(f'{value:.6g}' for value in found.numerator)),
        ('denominator of G', ', '.join(f'{value:.6g}' for value in found.denominator)),
        ('poles', ', '.join(_root(pole) for pole in poles)),
        ('delay', f'{found.delay} samples{delays}'),
        ('G is known to', f'{found.response_std.max():.2g} of itself, {hertz[0]:.2g} to '
                          f'{hertz[-1]:.2g} Hz'),
        ('noise of y', f'{found.noise_std:.3g}' + (
            f', steps of {found.quantum:.3g}' if found.quantum else '')),
        ('error on samples held out', NOTHING if held is None else
         f'{held.rms:.3g} (fit: {held.trained:.3g})'),
        ('correlation of the residual', f'{found.correlation:.2g} from sample to sample'
         if isfinite(found.correlation) else NOTHING),
        ('lost samples, outliers', f'{int(np.isnan(found.y).sum())}, {found.outliers}'),
    ], columns=1)


def _root(root: complex) -> str:
    return f'{root.real:.5g}' if abs(root.imag) < 1e-9 else \
        f'{root.real:.5g} {"+" if root.imag > 0 else "−"} {abs(root.imag):.5g} i'
