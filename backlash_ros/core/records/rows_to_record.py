"""From the columns of a log, as they are, to a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import LARGEST
from backlash_ros.core.records.readings import failed, held, quantum, unwrapped
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.rows import in_order, in_seconds, typical_step
from backlash_ros.core.records.timing import Rows, on_grid, seconds

Array = NDArray[np.float64]

SAME_UNIT = 0.3  # relative distance of a step from the period in a unit
UNITS_S = (1e-3, 1e-6, 1e-9, 60.0)  # that stamps may count, beside seconds


def record_of(
    t: Array | None, v: Array, y: Array, period: float | None = None,
    unit_s: float | None = None, commands: Array | None = None,
) -> Record:
    """A record from rows (N,) of a log; nan for what is not known.

    t: stamps, None where there are none. period [s]: from sample to sample, None tells it from the
    stamps. unit_s: of the stamps [s], None where the log does not say it. Raises RecordError.
    """
    said: list[str] = []
    notes: list[str] = []
    if len(v) < 2:
        raise RecordError(f'holds {len(v)} row, which is no motion')
    v, y = _without_infinite('v', v, notes), _without_infinite('y', y, notes)
    stamps = _stamps(t, len(v), period, unit_s, said)
    ordered = in_order(stamps)
    said += ordered.said
    rows = ordered.rows
    times, v, y = ordered.t, v[rows], y[rows]
    commands = None if commands is None else commands[rows]
    times, v, y, commands = _without_repeated_rows(times, v, y, commands, said)
    _checked('v', v)
    y = _checked('y', y)
    y = _readings(y, v, notes)
    v, turn = unwrapped(v)
    if turn:
        notes.append(f'v jumps by {turn:.6g} where it begins anew: the turns are counted')
    first = int(np.argmax(np.isfinite(v)))
    times, v, y = times[first:] - times[first], _held(v)[first:], y[first:]
    if commands is not None:
        commands = _held(commands)[first:]
    repeated = held(times, y)
    own = np.isfinite(y) if repeated is None else repeated.own
    if repeated is not None:
        per_row = len(y) / max(np.count_nonzero(own), 1)
        said.append(f'y repeats {per_row:.2g} times: {1.0 / repeated.period:.3g} Hz')
    grid = on_grid(Rows(times, v, y, own, commands), period)
    return usable(Record(
        grid.v, grid.y, grid.period, quantum(y), timing='; '.join([grid.said, *said]),
        notes=tuple(notes), commands=grid.commands,
    ))


def record_of_samples(t: Array, v: Array, y: Array, period: float) -> Record:
    """A record from samples (N,) of a run of this package, which have their true time t [s]."""
    grid = on_grid(Rows(t - t[0], v, y, np.isfinite(y)), period)
    return usable(Record(grid.v, grid.y, grid.period, quantum(y), timing=grid.said))


def usable(record: Record) -> Record:
    """From the first known v on; a v that is not known is the one before it.

    Before the first command the motor rests where it is. Raises RecordError where v or y are no
    measurements.
    """
    v, y, commands = _checked('v', record.v), _checked('y', record.y), record.commands
    first = int(np.argmax(np.isfinite(v)))
    v, y = _held(v)[first:], y[first:]
    if np.ptp(v) == 0.0:
        raise RecordError(
            f'v does not move, it is {v[0]:.6g} throughout: move it to and fro, past the gap; if '
            'another column is the command, name it with --columns'
        )
    if commands is not None:
        commands = _held(commands)[first:]
        commands = np.where(np.isnan(commands), v[0], commands)
        if not np.abs(commands).max() <= LARGEST:
            commands = None
    return replace(
        record, v=v, y=y, sample_period=float(f'{record.sample_period:.9g}'), commands=commands
    )


def _stamps(
    t: Array | None, count: int, period: float | None, unit_s: float | None, said: list[str],
) -> Array:
    """Stamps [s]; rows are counted where there are none, or none that move."""
    known = np.empty(0) if t is None else t[np.isfinite(t)]
    moves = np.unique(known).size > 1
    if t is None or not moves:
        what = 'there is no column for t' if t is None else 't does not move'
        if period is None:
            raise RecordError(f'{what}: give --period S, the time from row to row')
        said.append(f'{what}: rows are counted')
        return period * np.arange(count, dtype=float)
    stamps, guess = in_seconds(t, unit_s)
    if guess:
        said.append(guess)
    if unit_s is None and not guess:
        stamps = _in_unit_of(stamps, period, said)
    return stamps


def _in_unit_of(t: Array, period: float | None, said: list[str]) -> Array:
    """Stamps of an unknown unit: by the period, where it is given."""
    known = t[np.isfinite(t)]
    step = abs(typical_step(known if known[-1] > known[0] else known[::-1]))
    whole = bool((known == np.round(known)).all())
    if period is None:
        if whole and step >= 1.0:
            said.append(
                't, in whole numbers, is taken as seconds; if it counts something else: --period'
            )
        return t
    for unit in UNITS_S:
        if abs(step * unit / period - 1.0) < SAME_UNIT:
            said.append(f't counts {seconds(unit)}')
            return t * unit
    if whole and step == 1.0:
        said.append('t counts the samples')
        return t * period
    return t


def _without_repeated_rows(
    t: Array, v: Array, y: Array, commands: Array | None, said: list[str],
) -> tuple[Array, Array, Array, Array | None]:
    """Without rows that repeat all of the one before."""
    def same(values: Array) -> NDArray[np.bool_]:
        unknown = np.isnan(values)
        return np.asarray((values[1:] == values[:-1]) | (unknown[1:] & unknown[:-1]))

    again = np.append(False, same(t) & same(v) & same(y))
    if not again.any():
        return t, v, y, commands
    said.append(f'{np.count_nonzero(again)} rows that repeat the one before left out')
    return t[~again], v[~again], y[~again], None if commands is None else commands[~again]


def _readings(y: Array, v: Array, notes: list[str]) -> Array:
    """y without what is no reading of it."""
    bad, value = failed(y)
    if bad.any():
        notes.append(
            f'y reads exactly {value:.6g} in {np.count_nonzero(bad)} of {len(y)} rows, far from '
            'the rows around: taken for reads that failed'
        )
        y = np.where(bad, np.nan, y)
    y, turn = unwrapped(y)
    if turn:
        notes.append(f'y jumps by {turn:.6g} where it begins anew: the turns are counted')
    return y


def _without_infinite(name: str, values: Array, notes: list[str]) -> Array:
    infinite = np.isinf(values)
    if not infinite.any():
        return values
    notes.append(f'{name} is infinite in {np.count_nonzero(infinite)} rows: taken as lost')
    return np.where(infinite, np.nan, values)


def _checked(name: str, values: Array) -> Array:
    """The values; raises RecordError where they are no measurements."""
    if not np.isfinite(values).any():
        raise RecordError(f'{name} holds no number')
    largest = float(np.nanmax(np.abs(values)))
    swing = float(np.nanmax(values) - np.nanmin(values))
    if largest > LARGEST or 0.0 < swing < 1.0 / LARGEST:
        raise RecordError(
            f'{name} reaches {largest:.3g} and swings by {swing:.3g}, beyond '
            f'{1.0 / LARGEST:g} to {LARGEST:g}: choose another unit, drop what is no reading'
        )
    return values


def _held(values: Array) -> Array:
    """With the one before it for each that is not known."""
    newest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[newest])
