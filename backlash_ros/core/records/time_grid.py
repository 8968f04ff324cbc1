"""Convert rows of a log, with stamps of any kind, to v and y on one uniform grid.

Motion is smooth over the true instants: this tells true stamps from late ones, whose rows are
numbered instead. With true stamps v, which holds, is averaged over each period, and y is moved onto
the grid if its noise hides the error; else the grid is finer, and y unknown between readings.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from backlash_ros.core.control.limits import LARGEST_SIGNAL
from backlash_ros.core.loop.command_history import v_of_intervals
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records import readings, row_numbers, stamps
from backlash_ros.core.records.record import Record, RecordError, counted, seconds
from backlash_ros.core.records.row_numbers import Numbers

BREAK = 3.0  # periods without a row that are a break
MOST_SAMPLES = 1_000_000  # of a grid


class Rows(NamedTuple):
    """Rows in order of time: t (M,) [s], y (M,), nan without a reading of its own; v and commands,
    (M,) or times and values of their own (2, K). reported: v is what acted until its time."""

    t: Array
    v: Array
    y: Array
    commands: Array | None = None
    reported: bool = False


def record_of(
    t: Array | None, v: Array, y: Array, period: float | None = None,
    unit_s: float | None = None, commands: Array | None = None,
) -> Record:
    """Make a record of the rows (N,) of a log, nan where not known; raises RecordError.

    t: stamps. unit_s: unit of t [s], if the log gives it. period [s]: of the samples, if known.
    """
    said, notes = list[str](), list[str]()
    if len(v) < 2:
        raise RecordError(f'holds {len(v)} row, which is no motion')
    times = stamps.in_seconds(t, len(v), period, unit_s, said)
    # t, v, y and the commands, a row each.
    table = np.array([times, v, y] if commands is None else [times, v, y, commands])
    table[1:3][np.isinf(table[1:3])] = np.nan
    table = table[:, stamps.in_order(times, said)]
    _check(v=table[1], y=table[2])
    sent = None
    known_v, known_y = np.isfinite(table[1:3])
    if (known_v & known_y).sum() < 0.05 * min(known_v.sum(), known_y.sum()):
        said.append('v and y are in separate rows')
        table[1, known_v] = _with_turns_counted('v', table[1, known_v], notes)
        sent = table[:2, known_v]
        table[1, 0] = sent[1, 0]
        table[1] = _held(table[1])
        table = table[:, known_y]
    same = (table[:3, 1:] == table[:3, :-1]) | (np.isnan(table[:3, 1:]) & np.isnan(table[:3, :-1]))
    again = np.append(False, same.all(axis=0))
    if again.any():
        said.append(f'{again.sum()} rows that repeat the one before left out')
        table = table[:, ~again]
    table = table[:, int(np.argmax(np.isfinite(table[1]))):]
    begin = table[0, 0]
    t = stamps.spread_evenly(table[0] - begin, said, *table[1:3])
    v, y = without_turns(t, _held(table[1]), table[2], said, notes)
    if sent is not None:
        v = sent - np.array([[begin], [0.0]])
    record = on_grid(Rows(t, v, y, None if commands is None else _held(table[3])), period)
    return usable(record, y, said, notes)


def without_turns(
    t: Array, v: Array, y: Array, said: list[str], notes: list[str],
) -> tuple[Array, Array]:
    """v (N,) and y (N,) at t (N,) with turns counted; y nan where it is no reading of its own."""
    # Turns are counted first: after one, an angle is far from the rows around as well.
    bad, value = readings.failed(readings.unwrapped(y)[0])
    if bad.any():
        notes.append(f'y reads exactly {value:.6g} in {bad.sum()} of {len(bad)} rows, far from the '
                     'rows around: taken for reads that failed')
        y = np.where(bad, np.nan, y)
    y, v = _with_turns_counted('y', y, notes), _with_turns_counted('v', v, notes)
    y, turn = readings.without_slips(y, v)
    if turn:
        notes.append(f'y jumps by {turn:.6g}, a whole turn, while v does not: taken out')
    own, sensor_period = readings.own_readings(t, y)
    if sensor_period:
        said.append(f'y repeats {len(y) / own.sum():.2g} times: {1.0 / sensor_period:.3g} Hz')
    return v, np.where(own, y, np.nan)


def _with_turns_counted(name: str, values: Array, notes: list[str]) -> Array:
    values, turn = readings.unwrapped(values)
    if turn:
        notes.append(f'{name} jumps by {turn:.6g} where it wraps around: the turns are counted')
    return values


def usable(record: Record, read: Array, said: list[str], notes: list[str]) -> Record:
    """The record from the first known v on, with v held where it is not known. read: y before it
    was moved onto the grid. Raises RecordError if v or y cannot be measurements.
    """
    _check(v=record.v, y=record.y)
    first = int(np.argmax(np.isfinite(record.v)))
    v, commands = _held(record.v)[first:], record.commands
    if np.ptp(v) == 0.0:
        raise RecordError(f'v does not move, it is {v[0]:.6g} throughout: move it to and fro, past '
                          'the gap; if another column is the command, name it with --columns')
    if commands is not None:
        commands = _held(commands)[first:]
        # Before the first command the motor rests where it is.
        commands = np.where(np.isnan(commands), v[0], commands)
        commands = commands if np.abs(commands).max() <= LARGEST_SIGNAL else None
    return replace(
        record, v=v, y=record.y[first:], sample_period=float(f'{record.sample_period:.9g}'),
        quantum=readings.quantum(read), timing='; '.join([record.timing, *said]),
        notes=tuple(notes), commands=commands)


def _check(**signals: Array) -> None:
    """Raise RecordError for values that cannot be measurements."""
    for name, values in signals.items():
        if not np.isfinite(values).any():
            raise RecordError(f'{name} holds no number')
        largest, swing = np.nanmax(np.abs(values)), np.nanmax(values) - np.nanmin(values)
        if largest > LARGEST_SIGNAL or 0.0 < swing < 1.0 / LARGEST_SIGNAL:
            raise RecordError(f'{name} reaches {largest:.3g} and swings by {swing:.3g}, beyond '
                              f'{1.0 / LARGEST_SIGNAL:g} to {LARGEST_SIGNAL:g}: choose another '
                              'unit, or remove invalid readings')


def _held(values: Array) -> Array:
    """The values (N,) with each unknown one replaced by the last known one before it."""
    newest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[newest])


def on_grid(rows: Rows, period: float | None = None, late: bool = False) -> Record:
    """Put rows on a grid of this period [s], which is estimated if None; raises RecordError.

    late: stamps are those of messages, which may be late but never early.
    """
    nearly_even = 0.02  # share of a period by which stamps of even samples may be off
    guess = period or (stamps.typical_step(rows.t) if late else _period(rows.t))
    rows, cut = _longest_stretch(rows, guess)
    if len(rows.t) < 2 or not np.isfinite(rows.y).any():
        raise RecordError(f'{cut}y has no readings there: choose a part with --from, --to')
    found = (row_numbers.late if late else row_numbers.even)(rows.t, guess)
    if not found.period > 0.0 or found.numbers[-1] >= MOST_SAMPLES:
        raise RecordError('t does not rise steadily: give --period S, or cut out one motion')
    used = period or found.period
    if late or (np.abs(found.off).max() <= nearly_even * guess
                and abs(found.period / used - 1.0) <= nearly_even):
        what = 'messages of y' if late else 'rows'
        return _numbered_grid(rows, found.numbers, used,
                              f'{cut}{len(rows.t)} {what}, one every {seconds(used)}')
    steps = np.diff(rows.t)
    inner = steps[steps <= BREAK * max(stamps.typical_step(rows.t), guess)]
    mean = float(np.mean(inner))
    percent = f'{100.0 * float(np.std(inner)) / mean:.2g} %'
    come = f'{cut}stamps jitter by {percent} around {seconds(mean)}'
    found = row_numbers.likeliest(
        rows.t, *((0.98 * period, 1.02 * period) if period else (0.75 * mean, 1.03 * mean)))
    used = period or found.period
    # With too many rows missing, or too late, numbers would be wrong.
    if found.numbers[-1] + 1 <= 1.3 * len(rows.t) and np.std(found.off) <= used and sum(
            readings.rougher(rows.t, found.numbers.astype(float), signal)
            for signal in (rows.y, rows.v) if signal.ndim == 1) > 0.05:
        return _numbered_grid(rows, found.numbers, used, f'{come}, the motion is even: rows are '
                              f'numbered, one every {seconds(used)}')
    on_a_line = period is None and np.abs(found.off).max() <= 0.5 * used
    begin, step = (found.begin, used) if on_a_line else (float(rows.t[0]), guess)
    return _true_instants(rows, begin, step, f'{come}: v and y are taken at them, for samples of '
                          f'{seconds(step)}')


def _period(t: Array) -> float:
    """Approximate time from row to row."""
    steps = np.diff(t)
    steps = steps[steps <= BREAK * stamps.typical_step(t)]
    low, middle, high = np.percentile(steps, [15.0, 50.0, 85.0]).tolist()
    # With many equal stamps or uneven steps, only the mean is right.
    return float(f'{middle if high - low < 0.5 * middle else float(np.mean(steps)):.6g}')


def _longest_stretch(rows: Rows, period: float) -> tuple[Rows, str]:
    """The longest stretch of rows without a long break, and a text on what was cut off."""
    long_break = 100.0  # periods without a row that end a stretch
    t, span = rows.t, np.ptp(rows.t) / period
    if span < min(20.0 * len(t) + long_break, MOST_SAMPLES):
        return rows, ''
    ends = np.flatnonzero(np.diff(t, prepend=-np.inf, append=np.inf) > long_break * period)
    k = int(np.argmax(np.diff(ends)))
    part = slice(ends[k], ends[k + 1])
    if len(t[part]) < 2 or np.ptp(t[part]) >= MOST_SAMPLES * period:
        raise RecordError(
            f'spans {span:.3g} periods of {seconds(period)} with {len(t)} rows: cut out one motion '
            'with --from and --to, or give --period')
    kept: dict[str, Any] = {name: values[part] for name, values in rows._asdict().items()
                            if np.ndim(values) == 1}
    cut = rows._replace(**kept)
    return cut, (f'{counted(len(ends) - 2, "long break")}: the longest stretch, {len(cut.t)} rows, '
                 'is used; ')


def _numbered_grid(rows: Rows, index: Numbers, period: float, said: str) -> Record:
    """Put each row at its number; v holds over missing rows."""
    count = int(index[-1]) + 1
    y = np.full(count, np.nan)
    y[index] = rows.y
    missing = f', {count - len(index)} missing' if count > len(index) else ''

    def over(values: Array, reported: bool = False) -> Array:
        if values.ndim == 1:
            return values[np.searchsorted(index, np.arange(count), side='right') - 1]
        # Commands that come more often than samples are averaged.
        if not reported and values.shape[1] > 1.5 * count:
            return averaged(values[0] - rows.t[0], values[1], period, count)
        outputs_ns, sent_ns = ((1e9 * (each - rows.t[0])).astype(np.int64)
                               for each in (rows.t, values[0]))
        return v_of_intervals(index, outputs_ns, sent_ns, values[1], reported)

    return Record(over(rows.v, rows.reported), y, period, timing=said + missing,
                  commands=None if rows.commands is None else over(rows.commands))


def _true_instants(rows: Rows, begin: float, period: float, said: str) -> Record:
    """Average v over each period from begin [s] on, and put y where it was read."""
    hidden, least = 0.5, 1e-3  # error of moving y that does not matter, over its noise, its swing
    known = np.isfinite(rows.y)
    t, y = rows.t[known] - begin, rows.y[known]
    equal = int(np.count_nonzero(np.diff(rows.t) == 0.0))
    said += f'; {equal} rows with equal stamps' if equal else ''
    kept = np.append(np.diff(t) > 0.0, True)
    t, y = t[kept], y[kept]
    noise = readings.noise_of(t, y)
    bend = readings.curvature_of(t, y, noise)
    swing = float(np.ptp(np.percentile(y, [5.0, 95.0])))
    noise = max(noise, 12.0**-0.5 * readings.quantum(y), 0.01 * least * swing)
    for parts in (1, 2, 4):
        step = period / parts
        index, values = np.round(t / step).astype(np.int64), y
        off = index * step - t
        shared = np.mean(np.diff(index) == 0) > 0.02 if len(index) > 1 else False
        # A standard deviation that ignores jumps: 90 % of normal values are within 1.64 of it.
        moved = np.percentile(np.abs(np.gradient(y, t) * off), 90.0) / 1.64 if len(t) > 1 else 0.0
        if not shared and moved <= hidden * noise:
            break
        # Interpolate linearly to the next reading on that side.
        values = np.interp(index * step, t, y)
        share = np.clip(np.abs(off) / np.maximum(np.gradient(t), step), 0.0, 0.5)
        error = bend * float(np.sqrt(np.mean((4.0 * share * (1.0 - share))**2)))
        if error <= max(hidden * noise, least * swing):
            if shared and parts == 1:
                # At every instant of the grid between two readings that are close enough.
                index = np.arange(int(t[0] / step + 1.0 - 1e-9), int(t[-1] / step + 1e-9) + 1)
                after = np.clip(np.searchsorted(t, index * step), 1, len(t) - 1)
                index = index[t[after] - t[after - 1] <= 2.0 * step]
                values = np.interp(index * step, t, y)
            break
    said += f', on a grid of {seconds(step)}' if parts > 1 else ''
    count = int(max((rows.t[-1] - begin) / step + 0.5, index[-1])) + 1
    full = np.full(count, np.nan)
    full[index] = values

    def over(values: Array) -> Array:
        times, v = (rows.t, values) if values.ndim == 1 else values
        return averaged(times - begin, v, step, count)

    return Record(over(rows.v), full, step, timing=said,
                  commands=None if rows.commands is None else over(rows.commands))


def averaged(t: Array, v: Array, step: float, count: int) -> Array:
    """Mean of v (M,), which holds from each t (M,) to the next, over each of `count` steps."""
    edges = step * np.arange(count + 1)
    begin = np.clip(np.searchsorted(t, edges[:-1], side='right') - 1, 0, len(t) - 1)
    # Each change counts for the rest of its step, so that a v at rest keeps its exact value.
    changed = np.flatnonzero((t[1:] > edges[0]) & (t[1:] < edges[-1])) + 1
    of_step = np.searchsorted(edges, t[changed], side='left') - 1
    share = (v[changed] - v[changed - 1]) * (edges[of_step + 1] - t[changed]) / step
    return np.asarray(v[begin] + np.bincount(of_step, share, count))
