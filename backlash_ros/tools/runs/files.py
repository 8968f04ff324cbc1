"""A run and its files: the folder, samples.csv, record.npz, summary.json."""

import csv
import io
import json
import os
import sys
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from backlash_ros.atomic_file import point_link, write_atomically
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, complete_model
from backlash_ros.tools.cli import InputError

SAMPLES_FILE, RECORD_FILE = 'samples.csv', 'record.npz'
CONFIG_FILE, BAG = 'parameters.yaml', 'bag'
SAMPLE_COLUMNS = (*COLUMNS[:COLUMNS.index('u_hat')], 'status')


class Run(NamedTuple):
    """A simulated or recorded run; parameters: None if they are unknown.

    notes: on the source, a sentence each. applied: for each row, the v that acted since the row
    before, if the driver or a log tells it; else empty.
    """

    record: RunRecord
    parameters: Parameters | None
    notes: tuple[str, ...] = ()
    applied: Sequence[Sequence[float]] = ()

    def print_notes(self, tool: str) -> None:
        # The notes on a log, which say how it was read, are no warnings.
        warning = 'warning: ' if self.record.has_estimates else ''
        for note in self.notes:
            print(f'{tool}: {warning}{note}', file=sys.stderr)


def results_folder(out: Path | None) -> Path:
    """Create out, or results, and check that it can be written into; raises InputError.

    Called before a long run, so that the run is not lost.
    """
    results = out or Path('results')
    try:
        results.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{results}: cannot be made a folder: {error.strerror}') from None
    if not os.access(results, os.W_OK):
        raise InputError(f'{results}: cannot be written into: choose another --out')
    return results


def result_directory(out: Path | None) -> Path:
    """Create out, or results/<UTC time>, to which results/latest points; raises InputError."""
    results = results_folder(out)
    if out is not None:
        return out
    name = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H-%M-%SZ')
    for n in count():  # two runs within one second need two names
        directory = results / (f'{name}-{n}' if n else name)
        with suppress(FileExistsError):
            directory.mkdir()
            break
    try:
        point_link(results / 'latest', directory.name)
    except OSError as error:
        print(f'warning: {results / "latest"} does not point to {directory.name}: '
              f'{error.strerror}', file=sys.stderr)
    return directory


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Write strict JSON: numbers that are not finite become null."""
    known = json.loads(json.dumps(summary), parse_constant=lambda _: None)
    write_atomically(path, json.dumps(known, indent=2) + '\n')


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write a CSV with floats in full precision, and empty cells for None and nan."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator='\n')
    writer.writerow(header)
    writer.writerows([None if value != value else value for value in row] for row in rows)
    write_atomically(path, buffer.getvalue())


def write_run(run: RunRecord, directory: Path) -> None:
    """Write samples.csv for users, and record.npz with everything that `report` draws."""
    columns = np.column_stack([run.column(name) for name in SAMPLE_COLUMNS])
    write_table(directory / SAMPLES_FILE, SAMPLE_COLUMNS, columns.tolist())
    arrays: dict[str, Any] = {
        f'learned.{label}': values for label, values in (run.learned or {}).items()}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, columns=np.array(COLUMNS), rows=run.rows, sample_period=run.sample_period,
        lost_samples=run.lost_samples, **arrays)
    write_atomically(directory / RECORD_FILE, buffer.getvalue())


def rows_of(columns: Mapping[str, Array]) -> Array:
    """Rows of a RunRecord from its known columns, shape (N,), t among them; nan in all others."""
    unknown = np.full(len(columns['t']), np.nan)
    return np.column_stack([columns.get(name, unknown) for name in COLUMNS])


def read_record(path: Path) -> RunRecord:
    """Read record.npz, even an older one with fewer columns; raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            fields = {name.removeprefix('learned.'): stored[name].tolist()
                      for name in stored.files if name.startswith('learned.')}
            return RunRecord(
                rows_of(dict(zip(stored['columns'].tolist(), stored['rows'].T, strict=True))),
                float(stored['sample_period']), int(stored['lost_samples']),
                complete_model(fields))
    except (OSError, KeyError, ValueError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f'{path}: is not a record of a run: {error}') from None


def read_samples(path: Path, sample_period: float | None = None) -> RunRecord:
    """Read samples.csv. sample_period: the smallest step of t if None. Raises InputError."""
    try:
        with path.open(encoding='utf-8') as file:
            names = tuple(file.readline().strip().split(','))
            cells = np.array([[float(cell or 'nan') for cell in row] for row in csv.reader(file)])
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f'{path}: cannot be read: {error}') from None
    # Older files end with column f.
    if names not in (SAMPLE_COLUMNS, SAMPLE_COLUMNS[:10]):
        raise InputError(f'{path}: line 1: must be the header {",".join(SAMPLE_COLUMNS)}')
    if cells.shape[1:] != (len(names),):
        raise InputError(f'{path}: must hold rows of {len(names)} numbers')
    t = cells[:, 0]
    steps = np.diff(t)
    if falls := np.flatnonzero(~((steps > 0.0) & np.isfinite(steps))).tolist():
        raise InputError(f'{path}: line {falls[0] + 3}: t must be finite, and rise '
                         'from row to row')
    if sample_period is None and not len(steps):
        raise InputError(f'{path}: needs two samples to tell the sample period')
    period = sample_period or float(steps.min())
    lost = max(round((t[-1] - t[0]) / period) + 1 - len(t), 0)
    return RunRecord(rows_of(dict(zip(names, cells.T, strict=True))), period, lost)
