"""From the columns of a log, as they are, to a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import LARGEST_SIGNAL
from backlash_ros.core.records.readings import (
    failed,
    own_readings,
    quantum,
    unwrapped,
    without_slips,
)
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.stamps import in_order, in_seconds, spread_evenly
from backlash_ros.core.records.timing import Rows, on_grid

Array = NDArray[np.float64]


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
    stamps = in_seconds(t, len(v), period, unit_s, said)
    # t, v, y and the commands, a row each.
    table = np.array([stamps, v, y] if commands is None else [stamps, v, y, commands])
    for name, values in zip('vy', table[1:3], strict=True):
        infinite = np.isinf(values)
        if infinite.any():
            notes.append(f'{name} is infinite in {infinite.sum()} rows: taken as lost')
            values[infinite] = np.nan
    table = table[:, in_order(stamps, said)]
    _check(v=table[1], y=table[2])
    sent = None
    known_v, known_y = np.isfinite(table[1:3])
    if (known_v & known_y).sum() < 0.05 * min(known_v.sum(), known_y.sum()):
        said.append('v and y stand in rows of their own')
        sent = table[:2, known_v]
        table[1] = _held(np.where(np.arange(len(table[1])) > 0, table[1], sent[1, 0]))
        table = table[:, known_y]
    same = (table[:3, 1:] == table[:3, :-1]) | (np.isnan(table[:3, 1:]) & np.isnan(table[:3, :-1]))
    again = np.append(False, same.all(axis=0))
    if again.any():
        said.append(f'{again.sum()} rows that repeat the one before left out')
        table = table[:, ~again]
    table = table[:, int(np.argmax(np.isfinite(table[1]))):]
    t = spread_evenly(table[0] - table[0, 0], said, *table[1:3])
    v, y = readings(t, _held(table[1]), table[2], said, notes)
    _check(y=y)
    if sent is not None:
        v = sent - np.array([[table[0, 0]], [0.0]])
    record = on_grid(Rows(t, v, y, None if commands is None else _held(table[3])), period)
    return usable(record, y, said, notes)


def readings(
    t: Array, v: Array, y: Array, said: list[str], notes: list[str],
) -> tuple[Array, Array]:
    """v (N,) and y (N,) at t (N,) without whole turns; y nan where it is no reading of its own.

    What was done is added to said and notes.
    """
    # An angle that begins anew is far from the rows around as well.
    bad, value = failed(unwrapped(y)[0])
    if bad.any():
        notes.append(f'y reads exactly {value:.6g} in {bad.sum()} of {len(bad)} rows, far from the '
                     'rows around: taken for reads that failed')
        y = np.where(bad, np.nan, y)
    (y, turn_of_y), (v, turn_of_v) = unwrapped(y), unwrapped(v)
    for name, turn in (('y', turn_of_y), ('v', turn_of_v)):
        if turn:
            notes.append(f'{name} jumps by {turn:.6g} where it begins anew: the turns are counted')
    y, turn = without_slips(y, v)
    if turn:
        notes.append(f'y jumps by {turn:.6g}, a whole turn, while v does not: taken out')
    own, sensor_period = own_readings(t, y)
    if sensor_period:
        said.append(f'y repeats {len(y) / own.sum():.2g} times: {1.0 / sensor_period:.3g} Hz')
    return v, np.where(own, y, np.nan)


def usable(
    record: Record, read: Array, said: Sequence[str] = (), notes: Sequence[str] = (),
) -> Record:
    """From the first known v on; a v that is not known is the one before it.

    Before the first command the motor rests where it is. read: readings of y, whose step counts.
    said: on the stamps. Raises RecordError where v or y are no measurements.
    """
    _check(v=record.v, y=record.y)
    first = int(np.argmax(np.isfinite(record.v)))
    v, y, commands = _held(record.v)[first:], record.y[first:], record.commands
    if np.ptp(v) == 0.0:
        raise RecordError(f'v does not move, it is {v[0]:.6g} throughout: move it to and fro, past '
                          'the gap; if another column is the command, name it with --columns')
    if commands is not None:
        commands = _held(commands)[first:]
        commands = np.where(np.isnan(commands), v[0], commands)
        commands = commands if np.abs(commands).max() <= LARGEST_SIGNAL else None
    return replace(
        record, v=v, y=y, sample_period=float(f'{record.sample_period:.9g}'), quantum=quantum(read),
        timing='; '.join([record.timing, *said]), notes=tuple(notes), commands=commands)


def _check(**signals: Array) -> None:
    """Raise RecordError where the values are no measurements."""
    for name, values in signals.items():
        if not np.isfinite(values).any():
            raise RecordError(f'{name} holds no number')
        largest, swing = np.nanmax(np.abs(values)), np.nanmax(values) - np.nanmin(values)
        if largest > LARGEST_SIGNAL or 0.0 < swing < 1.0 / LARGEST_SIGNAL:
            raise RecordError(f'{name} reaches {largest:.3g} and swings by {swing:.3g}, beyond '
                              f'{1.0 / LARGEST_SIGNAL:g} to {LARGEST_SIGNAL:g}: choose another '
                              'unit, drop what is no reading')


def _held(values: Array) -> Array:
    """With the one before it for each that is not known."""
    newest = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[newest])
