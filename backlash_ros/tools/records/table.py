"""A table of numbers from a file: text with any separator and any head, or Parquet.

What has to be found out of a text (where its head ends, which sign separates, which one is the
decimal sign) pandas and polars have to be told as well, and both are larger than all else that this
package needs. Parquet is left to pyarrow, where it is installed.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backlash_ros.tools.cli import InputError
from backlash_ros.tools.records.columns import columns_of

Array = NDArray[np.float64]

NOT_KNOWN = {
    '', 'nan', 'null', 'none', 'na', 'n/a', '-', '--', 'nil', '?', '#n/a', 'bad', 'missing',
}
MOST_BROKEN = 0.1  # share of the lines that may be broken, and of the cells that are no number


@dataclass(frozen=True)
class Table:
    """Columns of a file. names: as in its head, or '1', '2', … where it has none.

    cells: text (or numbers) of each column, all of one length. comma: whether it is the decimal
    sign of the numbers.
    """

    path: Path
    names: tuple[str, ...]
    cells: tuple[Sequence[str] | Array, ...]
    comma: bool = False
    notes: tuple[str, ...] = ()

    def numbers(self, name: str, times: bool = False) -> Array:
        """A column as numbers (N,), nan where there is none; raises InputError.

        times: dates in ISO 8601 and times of day are numbers too, in seconds.
        """
        cells = self.cells[self.names.index(name)]
        if isinstance(cells, np.ndarray):
            return cells
        values, broken = np.full(len(cells), nan), []
        for k, cell in enumerate(cells):
            value = _number(cell, self.comma)
            if value is None and times:
                value = _date(cell)
            if value is not None:
                values[k] = value
            elif cell.lower() not in NOT_KNOWN:
                broken.append(k)
        if len(broken) > MOST_BROKEN * len(cells):
            raise InputError(
                f'{self.path}: column {name!r}: {cells[broken[0]]!r} in row {broken[0] + 1} is no '
                f'{"time" if times else "number"}, as in {len(broken)} of {len(cells)} rows: '
                f'choose another column with --columns; {columns_of(self.names)}'
            )
        return values


def _number(cell: str, comma: bool) -> float | None:
    try:
        return float(cell.replace(',', '.') if comma else cell)
    except ValueError:
        return None


def _date(cell: str) -> float | None:
    """Seconds of a date, or of a time of day; all stamps of one log are of one zone."""
    text = re.sub(r'( ?Z| UTC|[+-]\d\d:?\d\d)$', '', cell.strip('"'))
    text = text.replace('/', '-').replace(',', '.')
    text = text if '-' in text else f'1970-01-01 {text}'
    try:
        return float(np.datetime64(text).astype('datetime64[ns]').astype(np.int64)) * 1e-9
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
    wide = data[:2] in (b'\xff\xfe', b'\xfe\xff')
    if b'\0' in data[:4096] and not wide:
        raise InputError(f'{path}: is no text: give a CSV, a Parquet file, or the folder of a bag')
    for encoding in ('utf-16',) if wide else ('utf-8-sig', 'latin-1'):
        try:
            return _from_text(path, data.decode(encoding))
        except UnicodeDecodeError:
            continue
    raise InputError(f'{path}: is no text')


def _from_text(path: Path, text: str) -> Table:
    no_table = 'holds no table: give rows of numbers with t, v and y, separated by , ; or tabs'
    lines = text.replace('\0', '').splitlines()
    separator, count = _separator(lines)
    rows = [_split(line, separator) for line in lines]
    cells = [cell for row in rows if len(row) == count for cell in row]
    # A decimal comma needs another separator.
    comma = separator != ',' and sum(',' in cell for cell in cells) > sum(
        '.' in cell for cell in cells)

    def has_number(row: Sequence[str]) -> bool:
        return any(_number(cell, comma) is not None for cell in row)

    # A last row may be torn; trailing separators may be missing.
    data = [count - 1 <= len(row) <= count + 1 and has_number(row) for row in rows]
    if not count or not any(data):
        raise InputError(f'{path}: {no_table}')
    # From the middle of the file upwards: a table may stand below other ones.
    head = min(np.flatnonzero(data).tolist(), key=lambda k: abs(k - len(rows) // 2))
    filled = sum(map(bool, rows[head]))
    names: list[str] = []
    while head >= 0 and not names:
        head -= 1
        row = rows[head] if head >= 0 else []
        if row and _is_comment(lines[head]):
            row = _split(lines[head].lstrip('#%/ \t'), separator)
        width = max((k + 1 for k, cell in enumerate(row) if cell), default=0)
        if width >= max(2, filled - 1) and not has_number(row):
            names = row[:width]
    names = _told_apart(names, count)
    below = range(head + 1, len(rows))
    body = [[*rows[k], *[''] * (count - len(rows[k]))][:count] for k in below if data[k]]
    skipped = sum(
        not data[k] and lines[k].strip() != '' and not _is_comment(lines[k]) for k in below)
    if skipped > max(MOST_BROKEN * len(body), 3.0):
        raise InputError(
            f'{path}: {skipped} of {skipped + len(body)} lines are no rows of its table: '
            f'{columns_of(names)}; leave one table with t, v and y'
        )
    notes = (f'{skipped} broken line{"s" if skipped > 1 else ""} left out',) if skipped else ()
    return Table(path, tuple(names), tuple(zip(*body, strict=True)), comma, notes)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(('#', '%', '//'))


def _split(line: str, separator: str) -> list[str]:
    if separator == ' ':
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)] if line else []
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _separator(lines: list[str]) -> tuple[str, int]:
    """What separates the cells, and how many a row has; 0 where there is no table."""
    looked_at = 200  # lines by which the separator is told, from the middle of the file
    begin = max(len(lines) // 2 - looked_at // 2, 0)
    part = [line for line in lines[begin:begin + looked_at]
            if any(sign.isdigit() for sign in line) and not _is_comment(line)]
    best, most = (',', 0), 0.5
    for separator in ('\t', ';', ',', '|', ' '):
        rows = [_split(line, separator) for line in part]
        counts = Counter(
            len(row) for row in rows
            if len(row) > 1 and any(_number(cell, separator != ',') is not None for cell in row)
        )
        for count, times in counts.most_common(1):
            # The first of those that explain as much: a comma may be a decimal sign.
            if times / len(part) > 1.05 * most:
                best, most = (separator, count), times / len(part)
    return best


def _told_apart(head: Sequence[str], count: int) -> list[str]:
    """Names of all columns: numbers for those without, a second one of a name with its number."""
    names = [(head[k] if k < len(head) else '') or str(k + 1) for k in range(count)]
    again = [names[:k].count(name) + 1 for k, name in enumerate(names)]
    return [f'{name} ({n})' if n > 1 else name for name, n in zip(names, again, strict=True)]


def _from_parquet(path: Path) -> Table:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise InputError(f'{path}: is a Parquet file: pip install pyarrow, or save it as CSV') \
            from None
    try:
        table = parquet.read_table(path)
        columns = [column.to_numpy() for column in table.columns]
    except (ArrowException, OSError, ValueError) as error:
        raise InputError(f'{path}: cannot be read: {" ".join(str(error).split())}') from None
    return Table(path, tuple(table.column_names), tuple(
        column.astype('datetime64[ns]').astype(np.int64) * 1e-9 if column.dtype.kind == 'M' else
        column.astype(float) if column.dtype.kind in 'iufb' else
        ['' if cell is None else str(cell).strip() for cell in column.tolist()]
        for column in columns
    ))
