"""Read a record from a table, a folder of results or a bag; or read any of these as a run."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.time_grid import record_of
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli import WHOLE_SPAN, InputError, Span
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.records.columns import COMMAND, choose_columns
from backlash_ros.tools.records.table import read_table
from backlash_ros.tools.runs.files import SAMPLE_COLUMNS, Run, rows_of

NO_COLUMNS: Mapping[str, str] = {}


def read_record(
    path: Path, period: float | None = None, span: Span = WHOLE_SPAN, axis: str = '',
    columns: Mapping[str, str] = NO_COLUMNS,
) -> Record:
    """Read a table (CSV or the like, Parquet), a folder of results or a bag.

    period [s]: of the samples, from the record if None. columns: names by role (t, v, y, command)
    of the columns, or of the signals of a bag. Raises InputError, in one line.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    try:
        record = _from_table(path, period, columns) if _is_table(path) \
            else _from_run(path, period, axis, columns)
        record = record if span == WHOLE_SPAN else record.between(span.from_s, span.to_s)
    except RecordError as error:
        raise InputError(f'{path}: {error}') from None
    return replace(record, source=str(path))


def _from_table(path: Path, period: float | None, given: Mapping[str, str]) -> Record:
    table = read_table(path)
    chosen, said = choose_columns([*table.columns], given)
    t, unit_s = table.times(chosen.pop('t')) if 't' in chosen else (None, None)
    signals = {role: table.numbers(name) for role, name in chosen.items()}
    record = record_of(t, signals['v'], signals['y'], period, unit_s, signals.get(COMMAND))
    return replace(record, notes=(*filter(None, [said]), *table.notes, *record.notes))


def _from_run(path: Path, period: float | None, axis: str, columns: Mapping[str, str]) -> Record:
    # Imported here, as these modules take half a second to load.
    from backlash_ros.tools.records.messages import read_bag_record
    from backlash_ros.tools.runs.read_run import find_bag, read_run
    bag = find_bag(path)
    record = None if bag is None else read_bag_record(bag, period, axis, columns)
    if record is not None:
        return record
    source = read_run(path, axis=axis)
    t, v, y = (source.record.column(name) for name in 'tvy')
    record = record_of(t, v, y, period or source.record.sample_period, 1.0)
    return replace(record, notes=(*source.notes, *record.notes))


def _is_table(path: Path) -> bool:
    no_tables = ('.npz', '.mcap', '.db3', '.zstd', '.zst')  # of results and bags
    return path.is_file() and path.suffix.lower() not in no_tables


def read_run_or_log(
    path: Path, config: Path | None = None, span: Span = WHOLE_SPAN, axis: str = '',
    columns: Mapping[str, str] = NO_COLUMNS,
) -> Run:
    """Read a run of this package, or any log for `read_record` as a run without estimates.

    config: parameter file; that beside the run if None. Raises InputError.
    """
    from backlash_ros.tools.runs.read_run import find_bag, read_run
    no_run: InputError | None = None
    if not _is_table(path) or _is_samples(path):
        try:
            run = read_run(path, config, span, axis)
            if not run.record.samples:
                raise InputError(f'{path}: holds no sample')
            return run
        except InputError as error:
            if find_bag(path) is None:
                raise
            no_run = error
    parameters = None if config is None else read_configuration(config).parameters(axis)
    period, record = None if parameters is None else parameters.sample_period, None
    with suppress(InputError):  # as `identify` reads it, if the period fits
        record = read_record(path, None, span, axis, columns)
    try:
        if record is None or (period and abs(record.sample_period / period - 1.0) >= 0.01):
            record = read_record(path, period, span, axis, columns)
    except InputError as error:
        raise no_run or error from None
    known = np.flatnonzero(np.isfinite(record.y))
    applied = [[], *(part.tolist() for part in np.split(record.v, known)[1:-1])]
    # A log has no reference, on which learning does not depend.
    rows = rows_of({'t': record.sample_period * (known - known[0]), 'y_m': record.y[known],
                    'y': record.y[known], 'v': record.v[known]})
    run_record = RunRecord(
        rows, record.sample_period, int(known[-1] - known[0] + 1 - len(known)))
    return Run(run_record, parameters, (record.timing, *record.notes), applied)


def _is_samples(path: Path) -> bool:
    with suppress(OSError), path.open('rb') as file:
        return file.readline().decode(errors='replace').startswith(','.join(SAMPLE_COLUMNS[:10]))
    return False
