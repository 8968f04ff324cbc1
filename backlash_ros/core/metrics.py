"""Figures of merit of a run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.run_record import RunRecord

SETTLING_TOLERANCE = 0.01  # of the true value


def settling_time(
    t: NDArray[np.float64], estimate: NDArray[np.float64], truth: NDArray[np.float64],
) -> float | None:
    """First time [s] from which the estimate stays within 1 % of the truth; None if never."""
    outside = np.abs(estimate - truth) > SETTLING_TOLERANCE * np.abs(truth)
    last = np.flatnonzero(outside)
    if last.size == 0:
        return float(t[0])
    return float(t[last[-1] + 1]) if last[-1] + 1 < len(t) else None


def control_error_rms(run: RunRecord) -> float | None:
    """RMS of e = u - u_d (3.4) over the last second [unit of u]; None without the true u."""
    recent = run.column('t') > run.column('t')[-1] - 1.0
    e = (run.column('u') - run.column('u_d'))[recent]
    e = e[np.isfinite(e)]
    return float(np.sqrt(np.mean(e**2))) if e.size else None


def tracking_error_rms(run: RunRecord) -> float | None:
    """RMS of y - y_m over RMS of y_m in the last half; None for a reference at zero."""
    half = run.samples // 2
    y_m = run.column('y_m')[half:]
    size = float(np.sqrt(np.mean(y_m**2)))
    if size == 0.0:
        return None
    return float(np.sqrt(np.mean((run.column('y')[half:] - y_m) ** 2))) / size
