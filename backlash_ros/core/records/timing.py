"""From rows with stamps of any kind to v and y on one uniform grid.

Two kinds of uneven stamps are told apart by the motion itself, which is smooth over the true
instants: either the samples were taken evenly and their stamps are late, then rows are numbered; or
they were taken at those instants. Then v, which holds from row to row, is averaged over each period
of the grid, and y, which was read when it was read, is moved onto the grid only where the error of
that is hidden by its noise; else the grid is finer, with nothing between the readings.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.loop.sample_counter import CLOCK_SLACK, JITTER
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.record import RecordError
from backlash_ros.core.records.roughness import curvature_of, noise_of, rougher
from backlash_ros.core.records.rows import typical_step

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]

EVEN = 0.02  # of a period that stamps of even samples may be off
COARSE = 0.75  # of the last digit of the stamps, likewise
OFTEN_EQUAL = 0.2  # share of equal stamps from which the mean step is the period, not the median
NARROW = 0.25  # relative spread of the steps for which their median is the period
BREAK = 3.0  # periods from row to row that are a gap
LATE = 1.0  # periods: deviation of stamps that are late, beyond which rows cannot be numbered
MOST_LOST = 0.3  # share of the numbers without a row, likewise
DECIDED = 0.05  # log of the roughness that tells late stamps from true ones
FINER = (1, 2, 4)  # parts of a period
HIDDEN, LEAST = 0.5, 1e-3  # error of moving y that is hidden: of its noise, of its swing
ROUNDING = 12.0**-0.5  # deviation of rounding to whole numbers
NINE_TENTHS_TO_STD = 0.61  # of what 90 % of normal values stay within
MOST_SHARED = 0.02  # share of the readings that may fall onto one instant
LONGEST = 1_000_000  # samples of a grid
SPARSE, LONG_BREAK = 20.0, 100.0  # samples per row, and periods of a gap that ends a stretch


class Grid(NamedTuple):
    """v and y of N samples. at: number of the sample of each row that is used (for commands)."""

    v: Array
    y: Array
    period: float
    said: str
    commands: Array | None = None


class Rows(NamedTuple):
    """Rows in order. t (M,): from 0 [s]. own: whether y (M,) is a reading of its own."""

    t: Array
    v: Array
    y: Array
    own: Flags
    commands: Array | None = None

    def part(self, begin: int, end: int) -> Rows:
        """Some of them, t from 0 on."""
        t = self.t[begin:end]
        commands = None if self.commands is None else self.commands[begin:end]
        return Rows(t - t[0], self.v[begin:end], self.y[begin:end], self.own[begin:end], commands)


def on_grid(rows: Rows, period: float | None = None) -> Grid:
    """Rows on a grid. period [s]: of the samples, None tells it from the stamps.

    Raises RecordError where there are too few, or they are spread over too long a time.
    """
    told = period or _period(rows.t)
    rows, cut = _longest_stretch(rows, told)
    even = _even(rows.t, told)
    if even is not None:
        index, found = even
        kept = period or found
        said = f'{len(rows.t)} rows, one every {seconds(kept)}'
        grid = _numbered_grid(rows, index, kept, said)
    else:
        jitter = _jitter(rows.t, told)
        index, found = _numbers(rows.t, told if period is None else period, period is not None)
        if _are_late(rows, index, found):
            said = (
                f'stamps are uneven by {100.0 * jitter:.2g} % of {seconds(found)}, the motion is '
                'not: rows are numbered'
            )
            grid = _numbered_grid(rows, index, found, said)
        else:
            told, begin = _along(rows.t, told, period is not None)
            grid = _true_instants(
                rows._replace(t=rows.t - begin), told,
                f'stamps jitter by {100.0 * jitter:.2g} % around {seconds(told)}: v and y are '
                'taken at them',
            )
    return grid._replace(said='; '.join([*cut, grid.said]))


def seconds(time_s: float) -> str:
    """A time for people."""
    return f'{time_s * 1e3:.4g} ms' if time_s < 0.1 else f'{time_s:.4g} s'


def _period(t: Array) -> float:
    steps = np.diff(t)
    forward = typical_step(t)
    steps = steps[steps <= BREAK * forward]
    if np.mean(steps == 0.0) > OFTEN_EQUAL:
        return float(np.mean(steps))
    low, high = np.percentile(steps, [15.0, 85.0]).tolist()
    found = forward if high - low <= 2.0 * NARROW * forward else float(np.mean(steps))
    return float(f'{found:.6g}')


def _jitter(t: Array, period: float) -> float:
    steps = np.diff(t) / period
    steps = steps[steps <= BREAK]
    low, high = np.percentile(steps, [16.0, 84.0]).tolist()
    bulk = 0.5 * float(high - low)
    # A few odd ones among even stamps are told as well.
    return bulk if bulk > 0.005 else float(np.std(steps))


def _longest_stretch(rows: Rows, period: float) -> tuple[Rows, list[str]]:
    """Without what lies far before and after, where the time between holds no rows."""
    if rows.t[-1] / period < min(SPARSE * len(rows.t) + LONG_BREAK, LONGEST):
        return rows, []
    ends = np.flatnonzero(np.diff(rows.t) > LONG_BREAK * period) + 1
    bounds = np.concatenate([[0], ends, [len(rows.t)]])
    longest = int(np.argmax(np.diff(bounds)))
    part = rows.part(int(bounds[longest]), int(bounds[longest + 1]))
    if len(part.t) < 2 or part.t[-1] / period >= LONGEST:
        raise RecordError(
            f'spans {rows.t[-1] / period:.3g} periods of {seconds(period)} with {len(rows.t)} '
            'rows: cut out one motion with --from and --to, or give --period'
        )
    return part, [f'{len(ends)} long gaps: the longest stretch, {len(part.t)} rows, is used']


def _line(index: Numbers, t: Array) -> tuple[float, float]:
    slope, begin = np.polyfit(index, t, 1).tolist()
    return slope, begin


def _even(t: Array, period: float) -> tuple[Numbers, float] | None:
    """Number of each row and the period, where stamps are even but for rounding; else None."""
    coarse = _resolution(t)
    steps = np.diff(t) / period
    whole = np.round(steps)
    if coarse > 0.2 * period:
        # Stamps of a coarse clock may be equal; whoever reads it goes on row by row.
        whole = np.where(steps <= coarse / period + 0.6, 1.0, np.maximum(whole, 1.0))
    index = np.append(0, np.cumsum(whole)).astype(np.int64)
    if index[-1] < 1 or (np.diff(index) < 1).any():
        return None
    slope, begin = _line(index, t)
    off = float(np.abs(t - begin - slope * index).max())
    if off > max(EVEN * period, COARSE * coarse):
        return None
    # With no more digits than the stamps bear.
    return index, rounded(slope, 2.0 * max(off, 1e-12 * period) / float(index[-1]))


def _along(t: Array, period: float, keep: bool) -> tuple[float, float]:
    """Period and begin of the grid that the instants stay closest to. keep: the period as it is."""
    steps = np.round(np.diff(t) / period)
    if keep or (steps < 1.0).any():
        return period, 0.0
    index = np.append(0, np.cumsum(steps)).astype(np.int64)
    slope, begin = _line(index, t)
    off = np.abs(t - begin - slope * index)
    if float(off.max()) > 0.5 * slope:
        return period, 0.0
    return rounded(slope, 2.0 * float(np.std(off)) / float(index[-1])), begin


def _resolution(t: Array) -> float:
    """Value of the last decimal digit of the stamps t (N,)."""
    for digits in range(0, 8):
        scaled = t * 10.0**digits
        if np.abs(scaled - np.round(scaled)).max() < 1e-3:
            return float(10.0**-digits)
    return 0.0


def rounded(period: float, deviation: float) -> float:
    """The period with the fewest digits that is within its deviation."""
    for digits in range(1, 9):
        text = f'{period:.{digits}g}'
        if abs(float(text) - period) <= deviation:
            return float(text)
    return period


def numbered(times: Array) -> Numbers:
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
    return _risen(passed)


def _risen(numbers: NDArray[Any]) -> Numbers:
    """The numbers strictly rising from 0, the last of a heap keeping its place."""
    place = np.arange(len(numbers))
    risen = np.minimum.accumulate((numbers - place)[::-1])[::-1] + place
    return np.asarray(risen - risen[0], dtype=np.int64)


def _numbers(t: Array, period: float, keep: bool) -> tuple[Numbers, float]:
    """Number of each row, its stamp being late, and the period. keep: the period as it is."""
    if keep:
        return numbered(t / period), period
    steps = np.diff(t)
    best: tuple[float, Numbers, float] | None = None
    # The median of uneven steps is off by more than a long record bears.
    for guess in (period, float(np.mean(steps[steps < 0.5 * BREAK * period]))):
        for index in (numbered(t / guess), _risen(np.round((t - t[0]) / guess))):
            slope, begin = _line(index, t)
            # Around the line that all of them tell, as far as they are late by less than a period.
            index = _risen(np.round((t - begin) / slope))
            slope, begin = _line(index, t)
            left = float(np.std(t - begin - slope * index)) / slope
            if best is None or left < best[0]:
                best = left, index, rounded(slope, slope * left / float(index[-1]))
    assert best is not None
    return best[1:]


def _are_late(rows: Rows, index: Numbers, period: float) -> bool:
    """Whether the samples were even and only their stamps are late."""
    if index[-1] + 1 > (1.0 + MOST_LOST) * len(index):
        return False
    slope, begin = _line(index, rows.t)
    if float(np.std(rows.t - begin - slope * index)) > LATE * period:
        return False
    even = index.astype(float)
    y = np.where(rows.own, rows.y, np.nan)
    return rougher(rows.t, even, y) + rougher(rows.t, even, rows.v) > DECIDED


def _numbered_grid(rows: Rows, index: Numbers, period: float, said: str) -> Grid:
    """Each row at its number; v holds over those that are missing."""
    count = int(index[-1]) + 1
    held = np.searchsorted(index, np.arange(count), side='right') - 1
    y = np.full(count, np.nan)
    y[index[rows.own]] = rows.y[rows.own]
    missing = count - len(index)
    return Grid(
        rows.v[held], y, period, said + (f', {missing} missing' if missing else ''),
        None if rows.commands is None else rows.commands[held],
    )


def _true_instants(rows: Rows, period: float, said: str) -> Grid:
    """v averaged over each period, y where it was read."""
    t, y = rows.t[rows.own], rows.y[rows.own]
    keep = np.append(np.diff(t) > 0.0, True)
    equal = int(np.count_nonzero(np.diff(rows.t) == 0.0))
    t, y = t[keep], y[keep]
    if equal:
        said += f'; {equal} rows with equal stamps'
    noise = noise_of(t, y)
    bend = curvature_of(t, y, noise)
    swing = float(np.ptp(np.percentile(y, [5.0, 95.0])))
    noise = max(noise, ROUNDING * quantum(y), 0.01 * LEAST * swing)
    hidden = max(HIDDEN * noise, LEAST * swing)
    for parts in FINER:
        step = period / parts
        index = np.round(t / step).astype(np.int64)
        shared = float(np.mean(np.diff(index) == 0)) if len(index) > 1 else 0.0
        off = index * step - t
        if shared <= MOST_SHARED and _moved_by(t, y, off) <= HIDDEN * noise:
            values = y
            break
        # Along the line to the next reading on that side.
        values = np.interp(index * step, t, y)
        spacing = np.maximum(np.gradient(t) if len(t) > 1 else step, step)
        share = np.clip(np.abs(off) / spacing, 0.0, 0.5)
        error = bend * float(np.sqrt(np.mean((4.0 * share * (1.0 - share))**2)))
        if error <= hidden and (shared <= MOST_SHARED or parts > 1):
            break
        if error <= hidden:
            index, values = _bracketed(t, y, step)
            break
    if parts > 1:
        said += f', on a grid of {seconds(step)}'
    count = int(max(rows.t[-1] / step + 0.5, index[-1])) + 1
    full = np.full(count, np.nan)
    full[index] = values
    commands = None if rows.commands is None else averaged(rows.t, rows.commands, step, count)
    return Grid(averaged(rows.t, rows.v, step, count), full, step, said, commands)


def _moved_by(t: Array, y: Array, off: Array) -> float:
    """How much y moves from its instants to others, a standard deviation but for steps."""
    if len(t) < 2:
        return 0.0
    return NINE_TENTHS_TO_STD * float(np.percentile(np.abs(np.gradient(y, t) * off), 90.0))


def _bracketed(t: Array, y: Array, step: float) -> tuple[Numbers, Array]:
    """Every instant of the grid between two readings that are near enough, on their line."""
    index = np.arange(int(t[0] / step + 1.0 - 1e-9), int(t[-1] / step + 1e-9) + 1)
    after = np.clip(np.searchsorted(t, index * step), 1, len(t) - 1)
    near = t[after] - t[after - 1] <= 2.0 * step
    return index[near], np.interp(index[near] * step, t, y)


def averaged(t: Array, v: Array, step: float, count: int) -> Array:
    """v (M,), held from each t (M,) to the next, over each of `count` steps."""
    edges = step * np.arange(count + 1)
    begin = np.clip(np.searchsorted(t, edges[:-1], side='right') - 1, 0, len(t) - 1)
    # Each change counts for what is left of its step: where v rests it stays the same number.
    changed = np.flatnonzero((t[1:] > edges[0]) & (t[1:] < edges[-1])) + 1
    of_step = np.searchsorted(edges, t[changed], side='left') - 1
    share = (v[changed] - v[changed - 1]) * (edges[of_step + 1] - t[changed]) / step
    return np.asarray(v[begin] + np.bincount(of_step, share, count))
