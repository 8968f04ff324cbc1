"""A table of numbers from a file: text with any separator and any head, or Parquet.

Text is read with the csv module of Python: what has to be found out (where the head ends, which
sign separates, which one is the decimal sign) has to be told to pandas or polars as well, and both
are larger than all else that this package needs. Parquet is left to pyarrow, where it is installed.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backlash_ros.tools.cli import InputError
from backlash_ros.tools.records.columns import columns_of

Array = NDArray[np.float64]

SEPARATORS = ('\t', ';', ',', '|', ' ')
COMMENTS = ('#', '%', '//')
NOT_KNOWN = {
    '', 'nan', 'null', 'none', 'na', 'n/a', '-', '--', 'nil', '?', '#n/a', 'bad', 'missing',
}
LOOKED_AT = 200  # lines by which the separator is told, from the middle of the file
MOST_BROKEN = 0.1  # share of the lines that may be broken, and of the cells that are no number
NO_TABLE = 'holds no table: give rows of numbers with t, v and y, separated by , ; or tabs'
ENCODINGS = ('utf-8-sig', 'utf-16', 'latin-1')


@dataclass(frozen=True)
class Table:
    """Columns of a file. names: as in its head, or '1', '2', … where it has none.

    cells: text (or numbers) of each column, all of one length. decimal_comma: of the numbers.
    """

    path: Path
    names: tuple[str, ...]
    cells: tuple[Sequence[str] | Array, ...]
    decimal_comma: bool = False
    notes: tuple[str, ...] = ()

    def numbers(self, name: str) -> Array:
        """A column as numbers (N,), nan where there is none; raises InputError."""
        return self._parsed(name, times=False)

    def times(self, name: str) -> Array:
        """A column of stamps (N,): numbers as they are, dates and times of day in seconds."""
        return self._parsed(name, times=True)

    def _parsed(self, name: str, times: bool) -> Array:
        cells = self.cells[self.names.index(name)]
        if isinstance(cells, np.ndarray):
            return cells
        values, broken, example = np.full(len(cells), nan), 0, (0, '')
        for k, cell in enumerate(cells):
            value = number_in(cell, self.decimal_comma)
            if value is None and times:
                value = _date_in(cell)
            if value is not None:
                values[k] = value
            elif cell.strip().lower() not in NOT_KNOWN:
                broken += 1
                example = example if example[1] else (k, cell.strip())
        if broken > MOST_BROKEN * len(cells):
            raise InputError(
                f'{self.path}: column {name!r}: {example[1]!r} in row {example[0] + 1} is no '
                f'{"time" if times else "number"}, as in {broken} of {len(cells)} rows: choose '
                f'another column with --columns; {columns_of(self.names)}'
            )
        return values


def number_in(cell: str, decimal_comma: bool) -> float | None:
    """The number of a cell, None where it is none."""
    text = cell.strip()
    if decimal_comma:
        text = text.replace(',', '.')
    try:
        return float(text)
    except ValueError:
        return None


def _date_in(cell: str) -> float | None:
    """Seconds of a date in ISO 8601, or of a time of day."""
    text = cell.strip().strip('"')
    zone = text.rfind('+')
    # All stamps of one log are of one zone.
    text = text[:zone] if zone > 10 else text.removesuffix('Z').removesuffix(' UTC')
    text = text.replace('/', '-').replace(',', '.')
    try:
        if '-' in text:
            return float(np.datetime64(text).astype('datetime64[ns]').astype(np.int64)) * 1e-9
        return (datetime.strptime(
            text if '.' in text else f'{text}.0', '%H:%M:%S.%f'
        ) - datetime(1900, 1, 1)).total_seconds()
    except ValueError:
        return None


def read_table(path: Path) -> Table:
    """The table of a file; raises InputError, in one line."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error}') from None
    if data[:4] == b'PAR1':
        return _from_parquet(path)
    if b'\0' in data[:4096] and data[:2] not in (b'\xff\xfe', b'\xfe\xff'):
        raise InputError(f'{path}: is no text: give a CSV, a Parquet file, or the folder of a bag')
    for encoding in ENCODINGS:
        if encoding == 'utf-16' and data[:2] not in (b'\xff\xfe', b'\xfe\xff'):
            continue
        try:
            return _from_text(path, data.decode(encoding))
        except UnicodeDecodeError:
            continue
    raise InputError(f'{path}: is no text')


def _from_text(path: Path, text: str) -> Table:
    lines = text.replace('\0', '').splitlines()
    separator, count = _separator(lines)
    if not count:
        raise InputError(f'{path}: {NO_TABLE}')
    rows = [_split(line, separator) for line in lines]
    # A decimal comma needs another separator.
    comma = separator != ',' and _decimal_comma(rows, count)
    kinds = [_is_data(row, count, comma) for row in rows]
    # From the middle of the file upwards: a table may stand below other ones.
    middle = min(
        (k for k in range(len(rows)) if kinds[k]), key=lambda k: abs(k - len(rows) // 2), default=-1
    )
    if middle < 0:
        raise InputError(f'{path}: {NO_TABLE}')
    filled = sum(bool(cell) for cell in rows[middle])
    head = _head(rows, lines, middle, filled, separator, comma)
    names = _told_apart(head[1], count)
    body, skipped = [], 0
    for k in range(head[0] + 1, len(rows)):
        if kinds[k]:
            body.append([*rows[k], *[''] * (count - len(rows[k]))][:count])
        elif lines[k].strip() and not lines[k].lstrip().startswith(COMMENTS):
            skipped += 1
    if skipped > max(MOST_BROKEN * len(body), 3.0):
        raise InputError(
            f'{path}: {skipped} of {skipped + len(body)} lines are no rows of its table: '
            f'{columns_of(names)}; leave one table with t, v and y'
        )
    notes = (f'{skipped} broken line{"s" if skipped > 1 else ""} left out',) if skipped else ()
    return Table(path, names, tuple(zip(*body, strict=True)), comma, notes)


def _split(line: str, separator: str) -> list[str]:
    if separator == ' ':
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _separator(lines: list[str]) -> tuple[str, int]:
    """What separates the cells, and how many a row has; 0 where there is no table."""
    begin = max(len(lines) // 2 - LOOKED_AT // 2, 0)
    part = [line for line in lines[begin:begin + LOOKED_AT]
            if any(sign.isdigit() for sign in line) and not line.lstrip().startswith(COMMENTS)]
    best, most = (',', 0), 0.5
    for separator in SEPARATORS:
        counts = Counter(
            len(row) for row in (_split(line, separator) for line in part)
            if any(number_in(cell, separator != ',') is not None for cell in row)
        )
        counts.pop(0, None)
        counts.pop(1, None)
        if counts:
            count, times = counts.most_common(1)[0]
            # The first of those that explain as much: a comma may be a decimal sign.
            if times / len(part) > 1.05 * most:
                best, most = (separator, count), times / len(part)
    return best


def _decimal_comma(rows: list[list[str]], count: int) -> bool:
    cells = [cell for row in rows if len(row) == count for cell in row]
    return sum(',' in cell for cell in cells) > sum('.' in cell for cell in cells)


def _is_data(row: list[str], count: int, comma: bool) -> bool:
    """Whether it is a row of the table: of as many cells, or nearly, and with numbers."""
    # A last row may be torn; trailing separators may be missing.
    return count - 1 <= len(row) <= count + 1 and any(
        number_in(cell, comma) is not None for cell in row
    )


def _head(
    rows: list[list[str]], lines: list[str], middle: int, filled: int, separator: str, comma: bool,
) -> tuple[int, list[str]]:
    """The line with the names of the columns, the nearest one above, and them; -1 for none."""
    for k in range(middle - 1, -1, -1):
        line = lines[k].strip()
        row = _split(line.lstrip('#%/ '), separator) if line.startswith(COMMENTS) else rows[k]
        while row and not row[-1]:
            row = row[:-1]
        if len(row) >= max(2, filled - 1) and not any(
            number_in(cell, comma) is not None for cell in row
        ):
            return k, row
    return -1, []


def _told_apart(head: list[str], count: int) -> tuple[str, ...]:
    """Names of all columns: numbers for those without, a second one of a name with its number."""
    seen: Counter[str] = Counter()
    out = []
    for place in range(count):
        name = (head[place] if place < len(head) else '') or str(place + 1)
        seen[name] += 1
        out.append(name if seen[name] == 1 else f'{name} ({seen[name]})')
    return tuple(out)


def _from_parquet(path: Path) -> Table:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise InputError(f'{path}: is a Parquet file: pip install pyarrow, or save it as CSV') \
            from None
    try:
        table = parquet.read_table(path)
        names = tuple(table.column_names)
        cells = []
        for name in names:
            column = table.column(name).to_numpy()
            if column.dtype.kind == 'M':
                cells.append(column.astype('datetime64[ns]').astype(np.int64) * 1e-9)
            elif column.dtype.kind in 'iufb':
                cells.append(column.astype(float))
            else:
                cells.append(['' if cell is None else str(cell) for cell in column.tolist()])
    except (ArrowException, OSError, ValueError) as error:
        raise InputError(f'{path}: cannot be read: {" ".join(str(error).split())}') from None
    return Table(path, names, tuple(cells))
