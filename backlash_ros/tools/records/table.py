"""Read a table of numbers from a file: text with any separator and any head, or Parquet.

pandas and polars do not find the end of the head, the separator or the decimal sign by themselves
either, and are larger than all else that this package needs.
"""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import chain, compress
from math import nan
from pathlib import Path
from typing import NamedTuple

import numpy as np

from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records.record import RecordError, counted
from backlash_ros.tools.records.columns import UNITS_S, columns_of, unit_of

MOST_BROKEN = 0.1  # share of lines that may be broken, and of cells that may be no number
NO_NUMBER = {'', 'nan', 'null', 'none', 'na', 'n/a', '-', '--', 'nil', '?', '#n/a', 'bad',
             'missing', 'nat'}
COMMENT = re.compile(r'^\s*(?:[#%]|//)[#%/ \t]*')
DATES = ('%Y-%m-%d', '%Y.%m.%d', '%d.%m.%Y', '%d.%m.%y', '%d-%b-%Y', '%d-%b-%y',
         '%d-%B-%Y', '%m-%d-%Y', '%d-%m-%Y', '%m-%d-%y', '%d-%m-%y')
DATE_AND_TIME = re.compile(
    r'(\d+[-/. ]\w+[-/. ]\d+)?[t ,]*(?:(\d+:\d+(?::\d+)?(?:[.,:]\d+)?) ?(?:([ap])\.?m\.?)?'
    r'(?: ?Z| UTC|[+-]\d\d:?\d\d)?)?', re.IGNORECASE)


class Table(NamedTuple):
    """Cells by name of the column, or '1', '2', …. comma: whether it is the decimal sign."""

    columns: Mapping[str, Sequence[str]]
    comma: bool = False
    notes: tuple[str, ...] = ()

    def times(self, name: str) -> tuple[Array, float | None]:
        """Stamps (N,), and their unit [s] or None if the file does not tell; raises RecordError."""
        dates = times_of(self.columns[name])
        if np.isfinite(dates).mean() > 0.5:
            return dates, 1.0
        t = self.numbers(name, 'time')
        if re.fullmatch('date|datum', name.lower()) and 2e4 < np.nan_to_num(t).max() < 1e5:
            return t, 86400.0  # dates of a spreadsheet
        for other in self.columns:
            # Seconds and nanoseconds in two columns, as in headers of ROS messages.
            whole, nanoseconds = re.subn('n(ano)?(?=secs?$)', '', other)
            if nanoseconds and whole.rstrip('s') == name.rstrip('s'):
                return t + 1e-9 * self.numbers(other), 1.0
        return t, unit_of(name)

    def numbers(self, name: str, what: str = 'number') -> Array:
        """A column as numbers (N,), nan for cells without one; raises RecordError."""
        cells = self.columns[name]
        values = np.array([_number(cell, self.comma) for cell in cells], dtype=float)
        broken = [k for k in np.flatnonzero(np.isnan(values)) if cells[k].lower() not in NO_NUMBER]
        if len(broken) > MOST_BROKEN * len(cells):
            raise RecordError(
                f'column {name!r}: {cells[broken[0]]!r} in row {broken[0] + 1} is no {what}, as in '
                f'{len(broken)} of {len(cells)} rows: choose another column with --columns; '
                f'{columns_of([*self.columns])}')
        return values

    def by_name(self) -> Table:
        """If rows hold a name and a value, the table with a column for each such name."""
        columns = dict(self.columns)
        of_values = [name for name in columns
                     if re.fullmatch('.*(value|data|reading)', name.lower())]
        of_names = [name for name, cells in columns.items() if 2 <= len({*cells}) <= 20
                    and all(cell and _number(cell, self.comma) is None for cell in cells)]
        if len(of_values) != 1 or len(of_names) != 1:
            return self
        keys, values = columns.pop(of_names[0]), columns.pop(of_values[0])
        for name in sorted({*keys}):
            columns.setdefault(name, [value if key == name else ''
                                      for key, value in zip(keys, values, strict=True)])
        return self._replace(columns=columns)


def _number(cell: str, comma: bool) -> float | None:
    if ',' in cell:
        # If both occur, the last one is the decimal sign.
        decimal = cell.rfind(',') > cell.rfind('.') if '.' in cell else comma
        cell = cell.replace('.', '').replace(',', '.') if decimal else cell.replace(',', '')
    try:
        return float(cell)
    except ValueError:
        return None


def times_of(cells: Sequence[str]) -> Array:
    """Seconds (N,) of dates and times, or times of day, all in one zone; nan for other cells."""
    found = [DATE_AND_TIME.fullmatch(cell) for cell in cells]
    parts = [each.groups('') if each else ('', '', '') for each in found]
    dates = [re.sub('[/ ]', '-', date) for date, _, _ in parts]
    days = _days({*dates})
    return np.array([
        days.get(date, nan if date or not time else 0.0) + _time_of_day(time, half)
        for date, (_, time, half) in zip(dates, parts, strict=True)])


def _days(dates: Iterable[str]) -> Mapping[str, float]:
    """Seconds from 1970 to each date; all of them together tell what is the day in 3/4/2024."""
    found = [dict[str, float]() for _ in DATES]
    for days, form in zip(found, DATES, strict=True):
        for date in dates:
            with suppress(ValueError):
                days[date] = 86400.0 * (datetime.strptime(date, form).toordinal() - 719163)
    return min(found, key=lambda days: (
        -len(days), max(days.values(), default=0.0) - min(days.values(), default=0.0)))


def _time_of_day(time: str, half: str) -> float:
    hours, minutes, *seconds = (time or '0:0').replace(',', '.').split(':')
    if not seconds and '.' in minutes:  # 59:59.9
        hours, minutes, seconds = '0', hours, [minutes]
    hour = int(hours) % 12 + 12 * (half in 'pP') if half else int(hours)
    return 3600.0 * hour + 60.0 * int(minutes) + float('.'.join(seconds) or '0')


def read_table(path: Path) -> Table:
    """Read the table in a file; raises RecordError, in one line."""
    try:
        data = path.read_bytes()
        if data[:2] == b'\x1f\x8b':
            data = gzip.decompress(data)
    except (EOFError, OSError, zlib.error) as error:
        raise RecordError(f'cannot be read: {error}') from None
    if data[:4] == b'PAR1':
        return _from_parquet(path).by_name()
    try:
        text = data.decode('utf-16' if data[:2] in (b'\xff\xfe', b'\xfe\xff') else 'utf-8-sig')
    except UnicodeDecodeError:
        text = data.decode('latin-1')
    if '\0' in text:
        raise RecordError('is no text: give a CSV, a Parquet file, or the folder of a bag')
    return _from_text(text).by_name()


def _from_text(text: str) -> Table:
    lines = [line for line in text.replace('−', '-').splitlines() if line.strip()]
    bare = [not COMMENT.match(line) for line in lines]
    separator, count = _separator([*compress(lines, bare)])
    rows = [_split(COMMENT.sub('', line), separator) for line in lines]
    # A last row may be torn; trailing separators may be missing.
    data = [own and abs(len(row) - count) <= 1 and _is_numeric(row)
            for own, row in zip(bare, rows, strict=True)]
    if not count or not any(data):
        raise RecordError(
            'holds no table: give rows of numbers with t, v and y, separated by , ; or tabs')
    # Search the head from the middle upwards, as other tables may stand above this one.
    first = np.flatnonzero(data)[sum(data) // 2]
    wide = max(2, sum(map(bool, rows[first])) - 1)
    heads = [row for row in rows[:first]
             if sum(map(bool, row)) >= wide and not _is_numeric(row)] or [[]]
    head, units = heads[-1], list[str]()
    # rows.index finds the first of repeated heads: all belong to the same table.
    at = rows.index(head) if head in rows else -1
    if at > 0 and rows[at - 1] in heads and _are_units(head):
        head, units = rows[at - 1], head
    empty = [''] * count
    names = [cell or str(k + 1) for k, cell in enumerate([*head, *empty][:count])]
    # A repeated name gets a number.
    names = [f'{name} ({names[:k].count(name) + 1})' if name in names[:k] else name
             for k, name in enumerate(names)]
    names = [f'{name} [{unit.strip("[]() ")}]' if unit else name
             for name, unit in zip(names, [*units, *empty], strict=False)]
    below = [k for k in range(at + 1, len(rows)) if bare[k] and rows[k] not in (head, units)]
    body = [[*rows[k], *empty][:count] for k in below if data[k]]
    skipped = len(below) - len(body)
    if skipped > max(MOST_BROKEN * len(body), 3.0):
        raise RecordError(f'{skipped} of {skipped + len(body)} lines are no rows of its table: '
                          f'{columns_of(names)}; leave one table with t, v and y')
    comma, point = (sum(sign in cell for cell in chain(*body)) for sign in ',.')
    notes = (f'{counted(skipped, "broken line")} left out',) if skipped else ()
    cells = zip(*body, strict=True)
    return Table(dict(zip(names, cells, strict=True)), comma > point, notes)


def _is_numeric(row: Sequence[str]) -> bool:
    return any(_number(cell, True) is not None for cell in row)


def _split(line: str, separator: str) -> list[str]:
    if separator == ' ':
        return line.split()
    try:
        cells = next(csv.reader([line.strip(' ')], delimiter=separator), [])
    except csv.Error:
        return []
    return [cell.strip() for cell in cells]


def _separator(lines: Sequence[str]) -> tuple[str, int]:
    """The separator, and the number of cells in a row, 0 if there is no table."""
    looked_at = 200  # lines in the middle of the file that are looked at
    begin = max(len(lines) // 2 - looked_at // 2, 0)
    part = [line for line in lines[begin:begin + looked_at] if re.search(r'\d', line)]
    best, most = (',', 0), 0.5
    for separator in '\t;,| ':
        rows = (_split(line, separator) for line in part)
        counts = Counter(len(row) for row in rows if len(row) > 1 and _is_numeric(row))
        for count, times in counts.most_common(1):
            # Of those that explain as much, the first: a comma may be a decimal sign.
            if times / len(part) > 1.05 * most:
                best, most = (separator, count), times / len(part)
    return best


def _are_units(row: Sequence[str]) -> bool:
    """Whether a row below the names holds units, like [ms], deg, mm/s."""
    bare = [cell.strip('[]() ').lower() for cell in row]
    return all(len(cell) <= 9 for cell in bare) and (
        len({*bare}) < len(bare) or any(cell in UNITS_S for cell in bare)
        or all(cell[:1] in '[(' for cell in row))


def _from_parquet(path: Path) -> Table:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError:
        raise RecordError('is a Parquet file: pip install pyarrow, or save it as CSV') from None
    try:
        table = parquet.read_table(path)
        cells = [column.to_numpy().astype(str).tolist() for column in table.columns]
    except (ArrowException, OSError, ValueError) as error:
        raise RecordError(f'cannot be read: {" ".join(str(error).split())}') from None
    return Table(dict(zip(table.column_names, cells, strict=True)))
