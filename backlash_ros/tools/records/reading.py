"""A record from whatever a user has: a table, a folder of results, a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.rows_to_record import record_of, record_of_samples
from backlash_ros.tools.cli import WHOLE_SPAN, InputError, Span
from backlash_ros.tools.records.columns import choose_columns, unit_of
from backlash_ros.tools.records.table import Table, read_table
from backlash_ros.tools.runs.files import RECORD_FILE, SAMPLES_FILE

NO_TABLES = ('.npz', '.mcap', '.db3', '.zstd', '.zst')  # files of results and bags
NO_COLUMNS: Mapping[str, str] = {}


def read_record(
    path: Path, period: float | None = None, span: Span = WHOLE_SPAN, axis: str = '',
    columns: Mapping[str, str] = NO_COLUMNS,
) -> Record:
    """Read a table (CSV or the like, Parquet), a folder of results or a bag.

    period [s]: from sample to sample, None tells it from the record. columns: names by role (t, v,
    y, command); of a bag those of its signals. Raises InputError, in one line.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    try:
        record = _read(path, period, axis, columns)
        record = record if span == WHOLE_SPAN else record.between(span.from_s, span.to_s)
    except RecordError as error:
        raise InputError(f'{path}: {error}') from None
    return replace(record, source=str(path))


def is_table(path: Path) -> bool:
    """Whether a path is one of a table."""
    return path.is_file() and path.suffix.lower() not in NO_TABLES


def _read(path: Path, period: float | None, axis: str, columns: Mapping[str, str]) -> Record:
    if is_table(path):
        return _from_table(read_table(path), period, columns)
    # What reads bags takes half a second to load.
    from backlash_ros.tools.records.messages import read_bag_record
    from backlash_ros.tools.runs.read_run import find_bag, read_run
    bag = find_bag(path)
    if bag is not None:
        return read_bag_record(bag, period, axis, columns)
    if path.is_dir() and not any((path / name).is_file() for name in (RECORD_FILE, SAMPLES_FILE)):
        raise InputError(
            f'{path}: holds no bag, no {RECORD_FILE} and no {SAMPLES_FILE}: give one of them, or a '
            'table with t, v and y'
        )
    run = read_run(path).record
    if not run.samples:
        raise InputError(f'{path}: holds no sample')
    return record_of_samples(
        run.column('t'), run.column('v'), run.column('y'), period or run.sample_period
    )


def _from_table(table: Table, period: float | None, given: Mapping[str, str]) -> Record:
    chosen = choose_columns(table.names, given, table.path)
    record = record_of(
        table.times(chosen.t) if chosen.t else None,
        table.numbers(chosen.v), table.numbers(chosen.y), period,
        unit_of(chosen.t) if chosen.t else None,
        table.numbers(chosen.command) if chosen.command else None,
    )
    said = [chosen.said] if chosen.said else []
    return replace(record, notes=(*said, *table.notes, *record.notes))
