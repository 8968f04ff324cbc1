"""Which values of y are readings: no repetitions, failed reads or lost turns, which are recognised
only where nothing else explains them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NEARLY_ALL = 0.9  # share of what speaks for an explanation


def quantum(y: Array) -> float:
    """Step of a quantised y (N,), 0 where it is not quantised."""
    values = np.unique(y[np.isfinite(y)])
    if len(values) < 2 or len(values) > 0.8 * len(y):
        return 0.0
    steps = np.diff(values)
    steps[steps <= 1e-9 * (values[-1] - values[0])] = 0.0
    # From value to value, as the digits of a file may end before those of the step.
    numbers = np.append(0.0, np.cumsum(np.round(steps / steps[steps > 0.0].min())))
    step = float((values[-1] - values[0]) / numbers[-1])
    return step if np.abs((values - values[0]) / step - numbers).max() < 0.05 else 0.0


def own_readings(t: Array, y: Array) -> tuple[Flags, float]:
    """Rows (N,) in which y is a reading of its own, and the period [s] of a sensor slower than the
    rows, else 0. t (N,): instants [s], rising.

    A y that moves by several quanta a reading changes in every row, unless rows repeat it. At rest
    a reading looks like its repetition: one a period is taken.
    """
    fewest_changes = 12  # of y, beyond all rounding, that tell a slower sensor
    known = np.flatnonzero(np.isfinite(y))
    every = np.isfinite(y), 0.0
    values, times = y[known], t[known]
    moves = np.diff(values)
    changed = np.flatnonzero(moves != 0.0) + 1
    if not fewest_changes <= len(changed) <= 0.7 * len(values):
        return every
    clear = np.abs(moves[changed - 1]) >= 3.0 * (quantum(values) or 1e-9 * np.ptp(values))
    inner = changed[clear & (changed > 1) & (changed < len(values) - 1)]
    alone = (moves[inner - 2] == 0.0) & (moves[inner] == 0.0)
    if len(inner) < fewest_changes or np.mean(alone) < NEARLY_ALL:
        return every
    # During a motion: from each clear change to the one before it, whichever that is.
    since = np.diff(times[changed], prepend=np.nan)[np.isin(changed, inner)]
    low, period, high = np.nanpercentile(since, [15.0, 50.0, 85.0]).tolist()
    if not high - low <= period:
        return every
    begins, ends = np.append(0, changed), np.append(changed, len(times))
    until = np.append(times[changed], times[-1] + period)
    counts = np.maximum(((until - times[begins]) / period + 0.5).astype(int), 1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    at = np.searchsorted(times, np.repeat(times[begins], counts) + period * (number - 1e-9))
    own = np.zeros(len(y), dtype=bool)
    own[known[at[at < np.repeat(ends, counts)]]] = True
    return own, float(period)


def failed(y: Array) -> tuple[Flags, float]:
    """Rows (N,) of reads that failed, where drivers write 0, or the largest or smallest number of
    all, once or twice in a row, far from both neighbours; and that value."""
    known = np.flatnonzero(np.isfinite(y))
    values = y[known]
    rows = np.zeros(len(y), dtype=bool)
    for value in (0.0, float(values.min()), float(values.max())) if len(known) >= 10 else ():
        at = values == value
        if not 3 <= np.count_nonzero(at) <= 0.5 * len(values):
            continue
        edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
        runs = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
        others = np.flatnonzero(~at)
        between = np.interp(np.flatnonzero(at), others, values[others])
        # From one true reading to the next, as far as a motion goes.
        usual = float(np.percentile(np.abs(np.diff(values[others])), 75.0))
        far = np.abs(between - value) > 6.0 * max(usual, 1e-9 * float(np.ptp(values)))
        if np.mean(runs <= 2) >= NEARLY_ALL and np.mean(far) >= 0.5:
            rows[known[at]] = True
            return rows, value
    return rows, 0.0


def unwrapped(values: Array) -> tuple[Array, float]:
    """The values (N,) without the jumps of an angle that begins anew, and the turn; 0 for none.

    The values fill it and no more; all large jumps are whole turns, against the motion around them.
    """
    turn_tolerance = 0.02  # relative, of the jump of an angle that begins anew
    # Degrees, radians, gradians, steps of encoders.
    turns = (360.0, 2.0 * np.pi, 400.0, 6400.0, 3600.0, *(2.0**n for n in range(8, 33)))
    known = np.isfinite(values)
    if known.sum() < 10:
        return values, 0.0
    steps, reach = np.diff(values[known]), float(np.ptp(values[known]))
    usual = float(np.percentile(np.abs(steps), 95.0))
    for turn in turns:
        jumps = np.abs(steps) > 0.6 * turn  # no motion from row to row
        fills = 0.9 * turn <= reach <= (1.0 + turn_tolerance) * turn
        if not fills or not jumps.any() or usual > 0.1 * turn:
            continue
        off = np.abs(np.abs(steps[jumps]) - turn)
        motion = np.convolve(np.where(jumps, 0.0, steps), np.ones(7), mode='same')[jumps]
        if (off <= max(turn_tolerance * turn, 5.0 * usual)).all() and \
                np.mean(motion * np.sign(steps[jumps]) < 0.0) >= 0.8:
            return _without(turn, jumps, values), turn
    return values, 0.0


def _without(turn: float, jumps: Flags, values: Array) -> Array:
    known, out = np.isfinite(values), values.copy()
    turns = np.where(jumps, turn * np.sign(np.diff(values[known])), 0.0)
    out[known] -= np.append(0.0, np.cumsum(turns))
    return out


def without_slips(y: Array, v: Array) -> tuple[Array, float]:
    """y (N,) without rare jumps by a turn that v (N,) does not make, and that turn; 0 for none."""
    known = np.flatnonzero(np.isfinite(y))
    steps = np.diff(y[known])
    if len(steps) < 20:  # too few to judge a jump by
        return y, 0.0
    usual = 3.0 * float(np.percentile(np.abs(steps), 95.0))
    jumps = np.abs(steps) > 10.0 * usual
    moves = np.abs(np.diff(v, prepend=v[0]))
    lively = 3.0 * float(np.percentile(moves, 95.0))
    for turn in (2.0 * np.pi, 360.0) if 0 < jumps.sum() <= 0.01 * len(steps) else ():
        whole = np.abs(np.abs(steps[jumps]) - turn) <= usual + 1e-3 * turn
        alone = (moves[max(known[k] - 50, 0):known[k + 1] + 5].max() <= lively
                 for k in np.flatnonzero(jumps))
        if whole.all() and all(alone):
            return _without(turn, jumps, y), turn
    return y, 0.0
