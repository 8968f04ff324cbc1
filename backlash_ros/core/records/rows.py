"""Rows of a log in the order of time: turned around, sorted, without stamps that are none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.records.record import RecordError

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

WINDOW = 11  # rows: up to five stamps in a row may be wrong
BAD_STAMP = 50.0  # periods that a stamp is away from its neighbours
MOST_BAD = 0.1  # share of the rows
MOST_MOVED = 0.2  # share of the rows that may stand behind later ones
RESTART = 3.0  # periods by which a clock falls back that began anew; less is disorder
EPOCH = ((1e17, 1e-9, 'ns'), (1e14, 1e-6, 'µs'), (1e11, 1e-3, 'ms'))  # stamps of this century


class Ordered(NamedTuple):
    """Rows (N,) of the log that are kept, by time. t (N,): their stamps [s] from 0 on."""

    rows: Rows
    t: Array
    said: list[str]


def in_seconds(t: Array, unit_s: float | None) -> tuple[Array, str]:
    """Stamps (N,) in seconds, and in one sentence what was guessed, empty for nothing.

    unit_s: of the stamps, None where the log does not say it.
    """
    if unit_s is not None:
        return t * unit_s, ''
    typical = float(np.nanmedian(np.abs(t))) if np.isfinite(t).any() else 0.0
    for least, scale, unit in EPOCH:
        if typical > least:
            # Exact differences of numbers that hardly fit.
            return (t - t[np.isfinite(t)][0]) * scale, f't counts {unit} since 1970'
    return t, ''


def in_order(t: Array) -> Ordered:
    """Rows by time from stamps t (N,) [s]; raises RecordError where they make no sense."""
    said: list[str] = []
    rows = np.flatnonzero(np.isfinite(t))
    if len(rows) < len(t):
        said.append(f'{_count(len(t) - len(rows), "row")} without a time left out')
    if len(rows) < 2:
        raise RecordError(f'holds {_count(len(rows), "row")} with a time, which is no motion')
    steps = np.diff(t[rows])
    if np.count_nonzero(steps < 0.0) > np.count_nonzero(steps > 0.0):
        rows = rows[::-1]
        said.append('the newest row stood first: turned around')
    rows = _without_bad_stamps(rows, t, said)
    rows = _last_run(rows, t, said)
    stamps = t[rows]
    if (np.diff(stamps) < 0.0).any():
        moved = int(np.count_nonzero(np.diff(stamps) < 0.0))
        if moved > MOST_MOVED * len(rows):
            raise RecordError(
                f't falls back in {moved} of {len(rows)} rows: choose another column for t with '
                '--columns, or leave t out and give --period S'
            )
        rows = rows[np.argsort(stamps, kind='stable')]
        said.append(f'{_count(moved, "row")} out of order sorted by time')
    return Ordered(rows, t[rows] - t[rows[0]], said)


def typical_step(t: Array) -> float:
    """Median of the steps of t (N,) that go forward; raises RecordError where there is none."""
    steps = np.diff(t)
    forward = steps[steps > 0.0]
    if not len(forward):
        raise RecordError(
            't does not move: give --period S, the time from row to row, and rows are counted'
        )
    return float(np.median(forward))


def _without_bad_stamps(rows: Rows, t: Array, said: list[str]) -> Rows:
    """Without stamps that lie far from those of the rows around."""
    stamps = t[rows]
    step = typical_step(stamps)
    size = min(WINDOW, len(rows) - 1 + len(rows) % 2)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(stamps, size // 2, 'reflect'), size)
    away = np.abs(stamps - np.median(around, axis=1))
    bad = away > BAD_STAMP * step
    if np.mean(bad) > MOST_BAD:
        raise RecordError(
            f't jumps to and fro in {np.count_nonzero(bad)} of {len(rows)} rows: choose another '
            'column for t with --columns, or leave t out and give --period S'
        )
    if bad.any():
        said.append(f'{_count(int(bad.sum()), "row")} with a stamp far off left out')
    return np.asarray(rows[~bad])


def _last_run(rows: Rows, t: Array, said: list[str]) -> Rows:
    """The longest part in which the clock did not begin anew."""
    stamps = t[rows]
    falls = np.flatnonzero(np.diff(stamps) < -RESTART * typical_step(stamps)) + 1
    if not len(falls):
        return rows
    bounds = np.concatenate([[0], falls, [len(rows)]])
    longest = int(np.argmax(np.diff(bounds)))
    kept = rows[bounds[longest]:bounds[longest + 1]]
    if len(kept) < 0.2 * len(rows):
        raise RecordError(
            f't falls back {len(falls)} times: choose another column for t with --columns, or '
            'leave t out and give --period S'
        )
    said.append(
        f't begins anew {_count(len(falls), "time")}: the longest of {len(falls) + 1} parts, '
        f'{len(kept)} rows, is used'
    )
    return kept


def _count(number: int, what: str) -> str:
    return f'{number} {what}{"" if number == 1 else "s"}'
