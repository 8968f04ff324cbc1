"""Which values of y are readings of their own, and of the quantity that is meant.

Sensors that are slower than the log repeat their value, drivers write a fixed number where a read
failed, and angles begin anew after a turn. Each is recognised only where nothing else explains it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FEW_VALUES = 0.8  # distinct values per reading, more of which are not quantised
# Repeated readings: changes of y as large as this many quanta would show in every row.
CLEAR_CHANGE = 3.0
FEWEST_CHANGES = 12  # of that size
HELD_SHARE = 0.9  # of them that stand between rows without a change
REGULAR = 0.5  # relative spread of the time from change to change, for a sensor with a period
# Failed reads: one exact value, alone or in pairs, further from its neighbours than y moves.
FEWEST_FAILED, FAR, FAR_SHARE, LONGEST_RUN = 3, 6.0, 0.5, 2
# Of angles: degrees, radians, gradians, steps of encoders.
TURNS = (360.0, 2.0 * np.pi, 400.0, 6400.0, 3600.0, *(2.0**n for n in range(8, 33)))  # whole turns
TURN_TOLERANCE = 0.02  # relative, of the jump of an angle that begins anew
MOST_OF_TURN = 0.6  # of a turn: a jump as large as this is no motion from row to row


class Held(NamedTuple):
    """Repeated readings. own: rows (N,) with a reading of their own. period: of the sensor [s]."""

    own: Flags
    period: float


def quantum(y: Array) -> float:
    """Step of a quantised y (N,), nan where it is not known; 0 where it is not quantised."""
    known = y[np.isfinite(y)]
    values = np.unique(known)
    if len(values) < 2 or len(values) > FEW_VALUES * len(y):
        return 0.0
    steps = np.diff(values)
    step = float(steps[steps > 1e-9 * (values[-1] - values[0])].min())
    whole = (values - values[0]) / step
    return step if np.abs(whole - np.round(whole)).max() < 0.05 else 0.0


def held(t: Array, y: Array) -> Held | None:
    """Where y (N,) repeats the reading of a slower sensor; None where every row is a reading.

    t (N,): instants [s], rising. A y that moves by several quanta a reading changes in every row,
    unless rows repeat it. At rest a reading looks like its repetition: one a period is taken.
    """
    known = np.flatnonzero(np.isfinite(y))
    if len(known) < 3 * FEWEST_CHANGES:
        return None
    values, times = y[known], t[known]
    moves = np.diff(values)
    changed = np.flatnonzero(moves != 0.0) + 1
    if len(changed) > 0.7 * len(values) or len(changed) < FEWEST_CHANGES:
        return None
    clear = np.abs(moves[changed - 1]) >= CLEAR_CHANGE * _step_of(values)
    inner = changed[clear & (changed > 1) & (changed < len(values) - 1)]
    if len(inner) < FEWEST_CHANGES:
        return None
    alone = (moves[inner - 2] == 0.0) & (moves[inner] == 0.0)
    if np.mean(alone) < HELD_SHARE:
        return None
    # During a motion: from each clear change to the one before it, whichever that is.
    since = np.diff(times[changed], prepend=np.nan)[np.isin(changed, inner)]
    low, period, high = np.nanpercentile(since, [15.0, 50.0, 85.0]).tolist()
    if not high - low <= 2.0 * REGULAR * period:
        return None
    own = np.zeros(len(y), dtype=bool)
    own[known[_one_a_period(times, changed, period)]] = True
    return Held(own, float(period))


def _step_of(values: Array) -> float:
    """Quantum of the values, or the least change that is no rounding."""
    step = quantum(values)
    return step if step > 0.0 else 1e-9 * float(np.ptp(values))


def _one_a_period(times: Array, changed: NDArray[np.intp], period: float) -> NDArray[np.intp]:
    """Rows of changes, and between them one for each period that fits before the next one."""
    begins = np.append(0, changed)
    ends = np.append(changed, len(times))
    until = np.append(times[changed], times[-1] + period)
    counts = np.maximum(((until - times[begins]) / period + 0.5).astype(int), 1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    due = np.repeat(times[begins], counts) + period * (number - 1e-9)
    at = np.searchsorted(times, due)
    return np.asarray(np.unique(at[at < np.repeat(ends, counts)]))


def failed(y: Array) -> tuple[Flags, float]:
    """Rows (N,) that hold one exact value far from both neighbours, and that value.

    What drivers write where a read failed: 0, or the largest or smallest number of all.
    """
    known = np.flatnonzero(np.isfinite(y))
    none = np.zeros(len(y), dtype=bool), 0.0
    if len(known) < 10:
        return none
    values = y[known]
    for value in (0.0, float(values.min()), float(values.max())):
        at = values == value
        if not FEWEST_FAILED <= np.count_nonzero(at) <= 0.5 * len(values):
            continue
        edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
        runs = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
        if np.mean(runs <= LONGEST_RUN) < HELD_SHARE:
            continue
        others = np.flatnonzero(~at)
        between = np.interp(np.flatnonzero(at), others, values[others])
        # From one true reading to the next, as far as a motion goes.
        usual = float(np.percentile(np.abs(np.diff(values[others])), 75.0))
        far = np.abs(between - value) > FAR * max(usual, 1e-9 * float(np.ptp(values)))
        if np.mean(far) >= FAR_SHARE:
            rows = np.zeros(len(y), dtype=bool)
            rows[known[at]] = True
            return rows, value
    return none


def unwrapped(values: Array) -> tuple[Array, float]:
    """The values (N,) without the jumps of an angle that begins anew, and the turn; 0 for none.

    A turn is certain where every large jump is a whole known turn to a few usual steps.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 10:
        return values, 0.0
    own = values[known]
    steps = np.diff(own)
    reach = float(np.ptp(own))
    usual = float(np.percentile(np.abs(steps), 95.0))
    for turn in TURNS:
        # A wrapped angle fills its turn, and no more.
        if not 0.9 * turn <= reach <= (1.0 + TURN_TOLERANCE) * turn:
            continue
        jumps = np.abs(steps) > MOST_OF_TURN * turn
        if not jumps.any() or usual > 0.1 * turn:
            continue
        room = max(TURN_TOLERANCE * turn, 5.0 * usual)
        if (np.abs(np.abs(steps[jumps]) - turn) <= room).all() and _goes_on(steps, jumps):
            out = values.copy()
            out[known[1:]] -= turn * np.cumsum(np.where(jumps, np.sign(steps), 0.0))
            return out, turn
    return values, 0.0


def _goes_on(steps: Array, jumps: Flags) -> bool:
    """Whether the motion around nearly every jump goes the other way, as that of an angle does."""
    motion = np.convolve(np.where(jumps, 0.0, steps), np.ones(7), mode='same')
    return bool(np.mean(motion[jumps] * np.sign(steps[jumps]) < 0.0) >= 0.8)
