"""v and y, sample by sample, from a CSV, a folder of results or a bag."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backlash_ros import topics
from backlash_ros.bags.content import is_bag
from backlash_ros.core.control.limits import LARGEST
from backlash_ros.core.loop.intervals import REPORTED, v_of_intervals
from backlash_ros.core.loop.sample_counter import CLOCK_SLACK, JITTER
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.tools.report.command import BAG, open_source
from backlash_ros.tools.run_files.bag_reading import read_plain_numbers
from backlash_ros.tools.run_files.bag_sections import WHOLE, Span, choose_namespace
from backlash_ros.tools.run_files.results import RECORD, SAMPLES

Array = NDArray[np.float64]
Messages = tuple[NDArray[np.int64], Array]  # stamps [ns] and values

COLUMNS = ('t', 'v', 'y')
COMMAND = 'command'  # a fourth one, where v is what a motor encoder reports
OFF_GRID = 0.25  # of a period that a row of a CSV may miss its time
SIMULATED_BEFORE_NS = 10**17  # stamps: the clock of a machine is far beyond
LONGEST = 1_000_000  # samples, lost ones included: more is a t that jumps


@dataclass(frozen=True)
class MeasuredRecord:
    """v (N,) from sample k to k+1 and y (N,) at k, nan where lost. source: where they are from.

    notes: what else to know, a sentence each. commands: that led to v (N,), None where v is them.
    """

    v: Array
    y: Array
    sample_period: float
    source: str
    notes: tuple[str, ...] = ()
    commands: Array | None = None

    @property
    def lost(self) -> int:
        """Samples without a y."""
        return int(np.isnan(self.y).sum())


def read_measured(
    path: Path, sample_period: float | None = None, span: Span = WHOLE, axis: str = '',
) -> MeasuredRecord:
    """Read a bag, a folder of results, or a CSV with the columns t, v, y.

    sample_period: None tells it from the record. Raises InputError, in one line.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    if path.is_file() and path.suffix == '.csv':
        return _cut(_from_csv(path, sample_period), span)
    if path.is_dir():
        for folder in (path, path / BAG):
            if is_bag(folder):
                return _cut(_from_bag(folder, sample_period, axis), span)
        if not any((path / name).is_file() for name in (RECORD, SAMPLES)):
            raise InputError(
                f'{path}: holds no bag, no {RECORD} and no {SAMPLES}: give one of them, or a CSV '
                f'with the columns {", ".join(COLUMNS)}'
            )
    run = open_source(path).run
    if not run.samples:
        raise InputError(f'{path}: holds no sample')
    return _cut(_on_grid(
        path, run.column('t'), run.column('v'), run.column('y'),
        sample_period or run.sample_period,
    ), span)


def _from_csv(path: Path, sample_period: float | None) -> MeasuredRecord:
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f'{path}: cannot be read: {error}') from None
    header = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise InputError(
            f'{path}: line 1: must be a header with {", ".join(COLUMNS)}; {", ".join(missing)} '
            f'{"is" if len(missing) == 1 else "are"} missing'
        )
    for name in COLUMNS:
        if header.count(name) > 1:
            raise InputError(f'{path}: line 1: {name} stands there twice: leave one of them')
    names = (*COLUMNS, COMMAND) if COMMAND in header else COLUMNS
    places = [header.index(name) for name in names]
    values: list[list[float]] = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            cells = [row[place].strip() for place in places]
            values.append([float(cell) if cell else nan for cell in cells])
        except (ValueError, IndexError):
            raise InputError(
                f'{path}: line {number}: must hold numbers for {", ".join(COLUMNS)}; a lost y is '
                'left empty'
            ) from None
        if not isfinite(values[-1][0]):
            raise InputError(f'{path}: line {number}: t={values[-1][0]!r} must be finite')
        if len(values) > 1 and not values[-1][0] > values[-2][0]:
            raise InputError(f'{path}: line {number}: t must rise from row to row')
    if len(values) < 2:
        raise InputError(f'{path}: holds {len(values)} sample, which is no motion')
    t, v, y, *commands = np.array(values).T
    period = float(np.median(np.diff(t))) if sample_period is None else sample_period
    return _on_grid(path, t, v, y, period, *commands)


def _on_grid(
    path: Path, t: Array, v: Array, y: Array, period: float, commands: Array | None = None,
) -> MeasuredRecord:
    """Rows by time, those between them being lost."""
    place = (t - t[0]) / period
    index = np.round(place)
    if not index[-1] < LONGEST:
        raise InputError(f'{path}: spans {index[-1]:.3g} sample periods of {period:g} s')
    odd = np.flatnonzero((np.abs(place - index) > OFF_GRID) | (np.diff(index, prepend=-1) < 1))
    if len(odd):
        raise InputError(
            f'{path}: row {odd[0] + 1}: t={t[odd[0]]:.6g} is no whole number of sample periods of '
            f'{period:.6g} s: resample it, or give sample_period in --config'
        )
    whole = index.astype(int)
    count = int(whole[-1]) + 1
    full_v, full_y = np.full(count, nan), np.full(count, nan)
    full_v[whole], full_y[whole] = v, y
    full_commands = None
    if commands is not None:
        full_commands = np.full(count, nan)
        full_commands[whole] = commands
    return _usable(path, full_v, full_y, period, full_commands)


def _usable(
    path: Path, v: Array, y: Array, period: float, commands: Array | None = None,
) -> MeasuredRecord:
    """From the first known v on; a v that is not known is the one before it.

    Before the first command the motor rests where it is.
    """
    for name, values in (('v', v), ('y', y)):
        if np.isinf(values).any():
            raise InputError(f'{path}: {name} holds what is not finite')
        if not np.isfinite(values).any():
            raise InputError(f'{path}: {name} holds no number')
        largest = float(np.nanmax(np.abs(values)))
        swing = float(np.nanmax(values) - np.nanmin(values))
        if largest > LARGEST or 0.0 < swing < 1.0 / LARGEST:
            raise InputError(
                f'{path}: {name} reaches {largest:.3g} and swings by {swing:.3g}, beyond '
                f'{1.0 / LARGEST:g} to {LARGEST:g}: choose another unit, drop what is no reading'
            )
    first = int(np.argmax(np.isfinite(v)))
    if commands is not None:
        commands = _held(commands)[first:]
        commands = np.where(np.isnan(commands), v[first], commands)
        if not np.abs(commands).max() <= LARGEST:
            commands = None
    return MeasuredRecord(
        _held(v)[first:], y[first:], float(f'{period:.9g}'), str(path), commands=commands
    )


def _held(values: Array) -> Array:
    """With the one before it for each that is not known."""
    newest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[newest])


def _cut(record: MeasuredRecord, span: Span) -> MeasuredRecord:
    if span == WHOLE:
        return record
    t = record.sample_period * np.arange(len(record.v))
    # A time that is a sample's up to rounding is that sample's.
    slack = 1e-6 * record.sample_period
    kept = (t >= span.from_s - slack) & (t < span.to_s - slack)
    if not kept.any():
        raise InputError(f'{record.source}: there is no sample between --from and --to')
    commands = None if record.commands is None else record.commands[kept]
    return replace(record, v=record.v[kept], y=record.y[kept], commands=commands)


def _from_bag(path: Path, sample_period: float | None, axis: str) -> MeasuredRecord:
    names = (topics.PLANT_OUTPUT, topics.CONTROL, topics.APPLIED_CONTROL)
    numbers, damage = read_plain_numbers(path, names)
    notes = [damage] if damage else []
    chosen: dict[str, Messages] = {}
    for topic in names:
        ends = sorted(name for name in numbers if f'/{name}'.endswith(f'/{topic}'))
        if ends:
            name, note = choose_namespace(ends, axis)
            if name:
                chosen[topic] = numbers[name]
                axis = axis or (name.strip('/').split('/')[0] if note else '')
            if topic == topics.PLANT_OUTPUT and note:
                notes.append(note)
    output = chosen.get(topics.PLANT_OUTPUT)
    if output is None or len(output[0]) < 2 or output[0][0] < SIMULATED_BEFORE_NS:
        # Stamps of a simulated time do not tell what came first within a sample.
        return _from_signals(path, sample_period, axis)
    of_axis = f' of axis {axis}' if axis else ''
    record = from_messages(path, chosen, sample_period, of_axis)
    return replace(record, notes=(*record.notes, *notes))


def _from_signals(path: Path, sample_period: float | None, axis: str) -> MeasuredRecord:
    """From what the controller says that it heard and sent."""
    source = open_source(path, axis=axis)
    run = source.run
    record = _on_grid(
        path, run.column('t'), run.column('v'), run.column('y'),
        sample_period or run.sample_period,
    )
    return replace(record, notes=(*record.notes, *source.notes, *filter(None, [source.damage])))


def from_messages(
    path: Path, heard: Mapping[str, Messages], sample_period: float | None, of_axis: str = '',
) -> MeasuredRecord:
    """From stamps [ns] and values by topic, plant_output among them.

    v is that of applied_control where it is reported, else that of control. Raises InputError.
    """
    output = heard[topics.PLANT_OUTPUT]
    commands = heard.get(topics.APPLIED_CONTROL)
    reported = commands is not None and len(commands[0]) >= REPORTED * len(output[0])
    if not reported:
        commands = heard.get(topics.CONTROL)
    if commands is None or not len(commands[0]):
        raise InputError(f'{path}: holds no {topics.CONTROL}{of_axis}: record it as well')
    stamps = (output[0] - output[0][0]).astype(float)
    period = float(np.median(np.diff(stamps))) * 1e-9 if sample_period is None else sample_period
    if not period > 0.0:
        raise InputError(f'{path}: its stamps do not tell the sample period: give --config')
    index = _numbered(stamps * 1e-9 / period)
    if index[-1] >= LONGEST:
        raise InputError(f'{path}: spans {index[-1]:.3g} sample periods of {period:g} s')
    if sample_period is None:
        # All stamps together tell it better than one step does, but for how late the ends were.
        period, offset = np.polyfit(index, stamps * 1e-9, 1).tolist()
        late = float(np.std(stamps * 1e-9 - period * index - offset))
        # The first and the last stamp are late independently of each other.
        period = _rounded(period, 2.0**0.5 * late / float(index[-1]))
    count = int(index[-1]) + 1
    y = np.full(count, nan)
    y[index] = output[1]
    v = v_of_intervals(index, output[0], *commands, reported)
    sent = heard.get(topics.CONTROL) if reported else None
    if sent is None or not len(sent[0]):
        return _usable(path, v, y, period)
    return _usable(path, v, y, period, v_of_intervals(index, output[0], *sent, False))


def _numbered(times: Array) -> NDArray[np.int64]:
    """Number of each sample from its time [sample periods], rising from 0.

    Samples are late, never early: what comes before the next one is due is still the sample before,
    and of those that come in a heap the last one is the newest.
    """
    begin, number = float(times[0]), 0
    passed = np.zeros(len(times), dtype=np.int64)
    for i, time in enumerate(times.tolist()):
        newest = max(int(time - begin + 1.0 - JITTER), number)
        begin = min(begin + CLOCK_SLACK * (newest - number), time - newest)
        passed[i] = number = newest
    # Strictly rising, the last of a heap keeping its place.
    place = np.arange(len(times))
    numbers = np.minimum.accumulate((passed - place)[::-1])[::-1] + place
    return np.asarray(numbers - numbers[0], dtype=np.int64)


def _rounded(period: float, deviation: float) -> float:
    """The period with the fewest digits that is within its deviation."""
    for digits in range(1, 9):
        text = f'{period:.{digits}g}'
        if abs(float(text) - period) <= deviation:
            return float(text)
    return period
