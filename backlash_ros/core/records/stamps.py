"""Bring the stamps of a log to seconds and its rows in order of time, without invalid stamps."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records.record import RecordError, counted, seconds


def in_seconds(
    t: Array | None, count: int, period: float | None, unit_s: float | None, said: list[str],
) -> Array:
    """Stamps [s] of `count` rows; if t is None or does not move, rows are counted by their period.

    unit_s: unit of t [s], if the log gives it. said: what was done is added. Raises RecordError.
    """
    known = np.empty(0) if t is None else t[np.isfinite(t)]
    if t is None or np.unique(known).size < 2:
        what = 'there is no column for t' if t is None else 't does not move'
        if period is None:
            raise RecordError(f'{what}: give --period S, the time from row to row')
        said.append(f'{what}: rows are counted')
        return period * np.arange(count, dtype=np.float64)
    unit_s = unit_s or _guessed_unit(known, period, said)
    t = np.where(np.isfinite(t), t, np.nan)
    # Clocks that wrap around after 16 or 32 bits, a day, half a day, an hour.
    for around in (2.0**16, 2.0**32, *(hours * 3600.0 / unit_s for hours in (24.0, 12.0, 1.0))):
        falls = np.diff(t, prepend=t[0]) < -0.5 * around
        counted = t + around * np.cumsum(falls)
        steps = np.diff(counted)[falls[1:]]
        if 0 < len(steps) < 0.1 * count and (
                (steps >= 0.0) & (steps <= 3.0 * typical_step(known))).all():
            said.append(f't wraps around after {seconds(around * unit_s)}: continued')
            t = counted
            break
    # The median goes first: large stamps would lose digits when they are scaled.
    return np.asarray((t - np.median(known)) * unit_s)


def _guessed_unit(known: Array, period: float | None, said: list[str]) -> float:
    size = np.median(np.abs(known))
    for least, scale, unit in (1e17, 1e-9, 'ns'), (1e14, 1e-6, 'µs'), (1e11, 1e-3, 'ms'):
        if size > least:  # in this century
            said.append(f't counts {unit} since 1970')
            return scale
    step = typical_step(known if known[-1] > known[0] else known[::-1])
    if period is None:
        if step >= 1.0 and size < 1e9:  # else seconds since 1970
            said.append(f't is taken as seconds, {step:.3g} from row to row; if it counts '
                        'something else: --period')
        return 1.0
    for scale in (1e-3, 1e-6, 1e-9, 60.0):
        if abs(step * scale / period - 1.0) < 0.3:
            said.append(f't counts {seconds(scale)}')
            return scale
    if step == 1.0 and (known == np.round(known)).all():
        said.append('t counts the samples')
        return period
    return 1.0


def typical_step(t: Array) -> float:
    """Median of the forward steps of t (N,); raises RecordError if there are none."""
    steps = np.diff(t)
    if not (steps > 0.0).any():
        raise RecordError('t does not rise: give --period S, the time from row to row')
    return float(np.median(steps[steps > 0.0]))


def in_order(t: Array, said: list[str], what: str = 'row') -> NDArray[np.intp]:
    """Indices of the rows to keep, in order of their stamps t (N,) [s]; raises RecordError if the
    stamps make no sense. what: noun for a row. said: what was done is added."""
    rows = np.flatnonzero(np.isfinite(t))
    if len(rows) < len(t):
        said.append(f'{counted(len(t) - len(rows), what)} without a time left out')
    steps = np.diff(t[rows])
    if np.count_nonzero(steps < 0.0) > np.count_nonzero(steps > 0.0):
        rows = rows[::-1]
        said.append(f'the newest {what} came first: reversed')
    # Far from the median of the rows around, which bears five bad ones in a row.
    size = min(11, len(rows) - 1 + len(rows) % 2)
    around = np.median(
        sliding_window_view(np.pad(t[rows], size // 2, 'reflect'), size), axis=1)
    bad = np.abs(t[rows] - around) > 50.0 * typical_step(t[rows])
    # A clock that restarts falls back by several periods; smaller steps back are disorder.
    sound = rows[~bad]
    parts = np.split(sound, np.flatnonzero(np.diff(t[sound]) < -3.0 * typical_step(t[sound])) + 1)
    longest = max(parts, key=len)
    moved = np.count_nonzero(np.diff(t[longest]) < 0.0)
    if bad.sum() > 0.1 * len(rows) or len(longest) < 0.2 * len(sound) or moved > 0.2 * len(longest):
        raise RecordError(
            f't jumps to and fro in {bad.sum()} of {counted(len(rows), what)}, falls back in '
            f'{len(parts) - 1 + moved}: choose another column for t with --columns, or leave t '
            'out and give --period S')
    if bad.any():
        said.append(f'{counted(bad.sum(), what)} with a stamp far off left out')
    if len(parts) > 1:
        said.append(f't restarts {counted(len(parts) - 1, "time")}: the longest of {len(parts)} '
                    f'parts, {counted(len(longest), what)}, is used')
    if moved:
        said.append(f'{counted(moved, what)} out of order sorted by time')
    return longest[np.argsort(t[longest], kind='stable')]


def spread_evenly(t: Array, said: list[str], *signals: Array) -> Array:
    """Spread the stamps (N,) of a coarse clock evenly, if runs of rows share a stamp and the
    signals (N,) move within a run about as much as between runs: else rows repeat one reading."""
    begins = np.flatnonzero(np.diff(t, prepend=-np.inf) > 0.0)
    lengths, starts = np.diff(begins, append=len(t)), t[begins]
    if len(lengths) < 4 or np.median(lengths[:-1]) < 2.0:
        return t
    within = np.diff(t) == 0.0
    for moves in (np.abs(np.diff(signal)) for signal in signals):
        known = np.isfinite(moves)
        of_run, between = moves[within & known], moves[~within & known]
        if not len(of_run) or not len(between) or of_run.mean() <= 0.5 * between.mean():
            return t
    said.append(f'up to {lengths[:-1].max()} rows share a stamp, and move: spread evenly')
    place = np.arange(len(t))
    # The log may begin in the middle of a run, so the first one does not count.
    steps, counts = np.diff(starts)[1:], lengths[1:-1]
    whole = steps < 1.5 * np.median(steps)
    missing = np.round(steps * counts[whole].sum() / steps[whole].sum()) - counts
    paused = np.where(missing > 1.0, missing, 0.0)
    number = place + np.repeat(np.cumsum([0.0, 0.0, *paused]), lengths)
    period, begin = np.polyfit(number[begins[1:]], starts[1:], 1).tolist()
    off = starts[1:] - period * number[begins[1:]]
    if np.ptp(off) <= 1.5 * period:  # no single row is missing
        period = fewest_digits(period, 2.0 * float(np.std(off)) / float(number[-1]))
        return np.asarray(begin + period * number)
    period = float(np.median(steps / counts))
    starts[0] = starts[1] - period * lengths[0]
    lasting = np.minimum(period, np.diff(starts, append=np.inf) / lengths)
    return np.asarray(np.repeat(starts, lengths)
                      + np.repeat(lasting, lengths) * (place - np.repeat(begins, lengths)))


def fewest_digits(value: float, deviation: float) -> float:
    """The number with the fewest digits that is within `deviation` of the value."""
    texts = (float(f'{value:.{digits}g}') for digits in range(1, 9))
    return next((text for text in texts if abs(text - value) <= deviation), value)
