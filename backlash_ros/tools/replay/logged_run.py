"""A log of v and y, which no controller of this package made, as a run to replay."""

from __future__ import annotations

import numpy as np

from backlash_ros.core.records.record import Record
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord


def logged_run(record: Record) -> tuple[RunRecord, list[list[float]]]:
    """The run, a row for each reading of y, and the v of every interval before each row.

    y_m is y: a log names no reference, and what is learned does not depend on it.
    """
    known = np.flatnonzero(np.isfinite(record.y))
    rows = np.full((len(known), len(COLUMNS)), np.nan)
    t = record.sample_period * (known - known[0])
    for name, values in (
        ('t', t), ('y_m', record.y[known]), ('y', record.y[known]), ('v', record.v[known]),
    ):
        rows[:, COLUMNS.index(name)] = values
    lost = int(known[-1] - known[0] + 1 - len(known))
    applied = [[], *(part.tolist() for part in np.split(record.v, known)[1:-1])]
    return RunRecord(rows, record.sample_period, lost), applied
