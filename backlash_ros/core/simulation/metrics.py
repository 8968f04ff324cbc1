"""Figures of merit of a run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.simulation.run_record import RunRecord

SETTLING_TOLERANCE = 0.01  # of the true value


def settling_time(
    t: NDArray[np.float64], estimate: NDArray[np.float64], truth: NDArray[np.float64],
) -> float | None:
    """First time [s] from which the estimate stays within 1 % of the truth; None if never."""
    # Written so that an estimate that is not a number counts as outside.
    outside = ~(np.abs(estimate - truth) <= SETTLING_TOLERANCE * np.abs(truth))
    if outside.size == 0:
        return None
    last = np.flatnonzero(outside)
    if last.size == 0:
        return float(t[0])
    return float(t[last[-1] + 1]) if last[-1] + 1 < len(t) else None


def control_error_rms(run: RunRecord) -> float | None:
    """RMS of e = u - u_d (3.4) over the last second [unit of u]; None without the true u."""
    if run.samples == 0:
        return None
    recent = run.column('t') > run.column('t')[-1] - 1.0
    e = (run.column('u') - run.column('u_d'))[recent]
    e = e[np.isfinite(e)]
    return float(np.sqrt(np.mean(e**2))) if e.size else None


def delayed_reference(run: RunRecord, delay: int) -> NDArray[np.float64]:
    """y_m as it is to be followed: `delay` samples late, and y(0) before, shape (N,).

    delay: that of the structure. Rows of lost samples are missing from a run, so that the delay
    counts in sample periods, not in rows.
    """
    t, y_m = run.column('t'), run.column('y_m')
    due = t - (delay - 0.5) * run.sample_period
    newest = np.searchsorted(t, due, side='right') - 1
    return np.where(newest >= 0, y_m[np.maximum(newest, 0)], run.column('y')[:1])


def delayed_tracking_error_rms(run: RunRecord, delay: int, since: float = 0.0) -> float | None:
    """RMS of y - y_m(k - delay) over RMS of y_m(k - delay) from time `since` [s] on.

    None for a reference at zero.
    """
    rows = run.column('t') >= since
    reference = delayed_reference(run, delay)[rows]
    if reference.size == 0 or not np.any(reference):
        return None
    error = run.column('y')[rows] - reference
    return float(np.sqrt(np.mean(error**2) / np.mean(reference**2)))


def total_variation(values: NDArray[np.float64]) -> float:
    """Way that a signal went, up and down alike."""
    return float(np.abs(np.diff(values)).sum())


def turns(values: NDArray[np.float64], least: float) -> int:
    """How often a signal turned back by more than `least` from its extreme."""
    count, direction = 0, 0
    low = high = float(values[0]) if values.size else 0.0
    for value in values.tolist():
        low, high = min(low, value), max(high, value)
        if direction <= 0 and value - low > least:
            count, direction, high = count + (direction < 0), 1, value
        elif direction >= 0 and high - value > least:
            count, direction, low = count + (direction > 0), -1, value
    return count


def gap_crossings_per_reversal(run: RunRecord, since: float = 0.0) -> float | None:
    """Crossings of the gap by v for each reversal of y_m from time `since` [s] on.

    v crosses the gap where it turns back by more than half of it: one that falls short is
    counted, and noise within the gap is not. None without a true gap or without a reversal.
    """
    rows = run.column('t') >= since
    y_m, v = run.column('y_m')[rows], run.column('v')[rows]
    gap = run.column('true_c_r')[rows] - run.column('true_c_l')[rows]
    reversals = turns(y_m, 0.0)
    if reversals == 0 or not np.all(np.isfinite(gap)) or float(gap.max()) < 1e-6:
        return None
    return turns(v, 0.5 * float(gap.max())) / reversals
