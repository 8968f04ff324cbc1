"""y_m(t) from a file, for waveform: file."""

from __future__ import annotations

import csv
from math import isfinite
from pathlib import Path

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError


def read_reference_file(parameters: Parameters) -> tuple[float, ...]:
    """Values of the CSV with the header t,y_m and a row per sample period, from t = 0 on.

    Empty for any other waveform. Raises ParameterError, naming the line.
    """
    if parameters.waveform != 'file':
        return ()
    name, period = parameters.file, parameters.sample_period
    if not name:
        raise ParameterError('file', '', 'must name a CSV with rows t,y_m for waveform: file')
    try:
        with Path(name).open(newline='', encoding='utf-8') as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ParameterError('file', name, f'cannot be read: {error}') from None
    if [cell.strip() for cell in header] != ['t', 'y_m']:
        raise ParameterError('file', name, 'must begin with the header t,y_m')
    samples: list[float] = []
    for line, row in enumerate(rows, start=2):
        try:
            t, y_m = (float(cell) for cell in row)
        except ValueError:
            raise ParameterError('file', name, f'line {line} must hold t,y_m') from None
        due = len(samples) * period
        # A file in decimals rounds a little away.
        if not (abs(t - due) <= 1e-3 * period and isfinite(y_m)):
            raise ParameterError(
                'file', name, f'line {line} must hold t={due:.9g} and a finite y_m',
                f'one row per sample_period={period!r}',
            )
        samples.append(y_m)
    return tuple(samples)
