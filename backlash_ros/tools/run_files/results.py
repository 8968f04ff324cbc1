"""The files of a run: result folder, samples.csv, record.npz, summary.json."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backlash_ros.atomic_file import point_link, write_atomically
from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.learned_model import LearnedModel, from_fields
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.metrics import (
    control_error_rms,
    delayed_tracking_error_rms,
    settling_time,
)
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.topics import BACKLASH

RESULTS = Path('results')
LATEST = 'latest'
SAMPLES, RECORD, SUMMARY, CONFIG = 'samples.csv', 'record.npz', 'summary.json', 'parameters.yaml'
LEARNED = 'learned.'  # before the names of what record.npz has of G
SAMPLE_COLUMNS = ('t', 'y_m', 'y', 'u_d', 'v', 'u', 'm', 'c_r', 'c_l', 'f')


def result_directory(out: Path | None) -> Path:
    """Create and return the folder of the results: out, or results/<UTC time>.

    Only the latter is what results/latest then points at. Raises InputError.
    """
    if out is not None:
        _make(out)
        return out
    _make(RESULTS)
    # Two runs within one second need two names.
    name = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H-%M-%SZ')
    directory, more = RESULTS / name, 1
    while True:
        try:
            directory.mkdir()
            break
        except FileExistsError:
            more += 1
            directory = RESULTS / f'{name}-{more}'
    point_link(RESULTS / LATEST, directory.name)
    return directory


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f'{directory}: cannot be made a folder: {error.strerror}') from None


def summarise(
    run: RunRecord, parameters: Parameters | None, latency_s: NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Figures of merit of a run, the content of summary.json.

    parameters: None where they are not known. latency_s: of each sample, None for a simulation.
    Raises InputError for a run without samples.
    """
    if run.samples == 0:
        raise InputError('the run holds no sample that reached the controller')
    last = dict(zip(COLUMNS, run.rows[-1].tolist(), strict=True))
    truth, t = run.has_truth, run.column('t')
    settling = {
        name: settling_time(t, run.column(name), run.column(f'true_{name}')) if truth else None
        for name in BACKLASH
    }
    return {
        'estimator': parameters.get_str('estimator.law') if parameters else None,
        'structure': parameters.get_str('structure') if parameters else None,
        'samples': run.samples,
        'sample_period': run.sample_period,
        'lost_samples': run.lost_samples,
        'final': {name: last[name] for name in (*BACKLASH, 'f')},
        'final_std': {name: last[f'std_{name}'] for name in BACKLASH},
        'truth': {name: last[f'true_{name}'] if truth else None for name in BACKLASH},
        'settling_time_s': settling,
        'control_error_rms': control_error_rms(run),
        'tracking_error_rms': delayed_tracking_error_rms(
            run, reference_delay(parameters), float(t[run.samples // 2])
        ),
        'loop_latency_ms': latency_ms(latency_s),
        'final_status': _word(last['status']),
        'status_share': _status_share(run.column('status')),
        **_learned(run.learned),
    }


def _word(status: float) -> str | None:
    """The word for a status code, None for none."""
    return Status(int(status)).word if status in set(Status) else None


def _status_share(status: NDArray[np.float64]) -> dict[str, float] | None:
    """Share of the samples in each status, None where it was not recorded."""
    known = status[np.isfinite(status)]
    if known.size == 0:
        return None
    return {state.word: float(np.mean(known == state)) for state in Status}


def _learned(learned: LearnedModel | None) -> dict[str, Any]:
    if learned is None:
        return {'model': None, 'noise_ratio': None, 'unexplained': None}
    return {
        'model': {
            'numerator': list(learned.numerator), 'denominator': list(learned.denominator),
            'delay_samples': learned.delay_samples,
        },
        'noise_ratio': learned.noise_ratio, 'unexplained': learned.unexplained,
    }


def reference_delay(parameters: Parameters | None) -> int:
    """Samples by which y is to follow y_m late, which the structure decides; 0 if unknown."""
    return build_controller(parameters).structure.delay if parameters else 0


def latency_ms(latency_s: NDArray[np.float64] | None) -> dict[str, float] | None:
    """Quantiles [ms] of latencies [s], shape (samples,); None where none is known."""
    known = latency_s[np.isfinite(latency_s)] if latency_s is not None else np.empty(0)
    if known.size == 0:
        return None
    p50, p99 = np.percentile(known, [50, 99]) * 1e3
    return {'p50': float(p50), 'p99': float(p99)}


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """Write strict JSON: what is not finite becomes null."""
    text = json.dumps(_finite_or_null(summary), indent=2, allow_nan=False)
    write_atomically(path, text + '\n')


def _finite_or_null(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite_or_null(element) for key, element in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite_or_null(element) for element in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write a CSV; a float in full precision, nothing for None and nan."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator='\n')
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    write_atomically(path, buffer.getvalue())


def _cell(value: object) -> str:
    if value is None or value != value:
        return ''
    return repr(value) if isinstance(value, float) else str(value)


def write_run(run: RunRecord, directory: Path) -> None:
    """Write samples.csv for everyone, and record.npz with all that `report` can draw."""
    columns = [run.column(name) for name in SAMPLE_COLUMNS]
    write_table(directory / SAMPLES, SAMPLE_COLUMNS, np.column_stack(columns).tolist())
    learned = run.learned.fields() if run.learned is not None else {}
    arrays: dict[str, Any] = {
        f'{LEARNED}{label}': np.array(values) for label, values in learned.items()
    }
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, columns=np.array(COLUMNS), rows=run.rows, sample_period=run.sample_period,
        lost_samples=run.lost_samples,
        **arrays,
    )
    write_atomically(directory / RECORD, buffer.getvalue())


def read_record(path: Path) -> RunRecord:
    """Read record.npz; raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            given = [str(name) for name in stored['columns']]
            # A column that an older record lacks is unknown.
            rows = np.full((len(stored['rows']), len(COLUMNS)), np.nan)
            for i, name in enumerate(COLUMNS):
                if name in given:
                    rows[:, i] = stored['rows'][:, given.index(name)]
            fields = {
                name.removeprefix(LEARNED): stored[name].tolist()
                for name in stored.files if name.startswith(LEARNED)
            }
            return RunRecord(
                rows, float(stored['sample_period']), int(stored['lost_samples']),
                from_fields(fields) if fields else None,
            )
    except (OSError, KeyError, ValueError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f'{path}: is not a record of a run: {error}') from None


def read_samples(path: Path, sample_period: float | None = None) -> RunRecord:
    """Read samples.csv; the truth, standard deviations and further signals are unknown.

    sample_period: None takes the smallest distance of two rows. Raises InputError.
    """
    values = _read_numbers(path)
    t = values[:, 0]
    if len(t) > 1 and not np.all(np.diff(t) > 0.0):
        row = int(np.flatnonzero(~(np.diff(t) > 0.0))[0]) + 3
        raise InputError(f'{path}: line {row}: t must rise from row to row')
    if sample_period is None:
        if len(t) < 2:
            raise InputError(f'{path}: needs two samples to tell the sample period')
        sample_period = float(np.min(np.diff(t)))
    rows = np.full((len(t), len(COLUMNS)), np.nan)
    for i, name in enumerate(SAMPLE_COLUMNS):
        rows[:, COLUMNS.index(name)] = values[:, i]
    lost = max(round((t[-1] - t[0]) / sample_period) + 1 - len(t), 0)
    return RunRecord(rows, sample_period, lost)


def _read_numbers(path: Path) -> NDArray[np.float64]:
    try:
        with path.open(newline='', encoding='utf-8') as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f'{path}: cannot be read: {error}') from None
    if not rows or tuple(rows[0]) != SAMPLE_COLUMNS:
        raise InputError(f'{path}: line 1: must be the header {",".join(SAMPLE_COLUMNS)}')
    if len(rows) == 1:
        raise InputError(f'{path}: holds no sample')
    values = np.empty((len(rows) - 1, len(SAMPLE_COLUMNS)))
    for i, row in enumerate(rows[1:]):
        try:
            values[i] = [float(cell) if cell else np.nan for cell in row]
        except ValueError:
            raise InputError(
                f'{path}: line {i + 2}: must hold {len(SAMPLE_COLUMNS)} numbers'
            ) from None
    return values
