"""A recorded run through a controller once more, with its own parameters or with others.

The controller is the one of the loop and is stepped as there: it computes its command from every
recorded y and y_m. What it learns from is the v that was recorded: the reported one where the loop
would have believed it, else the command.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.control.controller import LONGEST_GAP
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.loop.command_history import ReportOrigin, ReportTrust, report_use
from backlash_ros.core.loop.learned_model import learned_model_of
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, row_of

Array = NDArray[np.float64]


class Parting(NamedTuple):
    """Where a replay parts from the estimates that the run had published.

    sample: row of the record; t: its time [s]. name: of the estimate, recorded and replayed: its
    values there. largest: difference over all rows, in standard deviations where they are known,
    else relative.
    """

    sample: int
    t: float
    name: str
    recorded: float
    replayed: float
    largest: float


def replay(
    recorded: RunRecord, p: Parameters, on_sample: Callable[[int], None] | None = None,
    reports: Sequence[Sequence[float]] = (),
) -> RunRecord:
    """Feed y, y_m, v and losses of a record to a controller with these parameters.

    The rows are those of the record, with the recorded y, y_m and v, and what this controller makes
    of them: u_d, estimates, status, innovation. reports: for each row what the driver said to have
    applied since the row before it. Raises ValueError for rows without numbers and
    ParameterError for parameters that contradict each other.
    """
    t = recorded.column('t')
    columns = [recorded.column(name) for name in ('y_m', 'y', 'v')]
    steps = np.diff(t, prepend=t[:1]) / recorded.sample_period
    lost = np.maximum(np.round(steps).astype(int) - 1, 0)
    controller = build_controller(p)
    rows = np.full((recorded.samples, len(COLUMNS)), np.nan)
    trust, origin = ReportTrust(report_use(p)), ReportOrigin()
    v_before = v_made = 0.0
    for k, (y_m, y, v) in enumerate(zip(*columns, strict=True)):
        y_m, y, v = float(y_m), float(y), float(v)
        if not (plausible(y_m) and plausible(y) and plausible(v)):
            raise ValueError(f't={t[k]:g}: y_m={y_m!r}, y={y!r} and v={v!r} must be finite')
        missing = int(lost[k])
        if missing > LONGEST_GAP:
            before, controller = controller, build_controller(p, controller.estimator.estimate)
            controller.go_on_from(before)
            missing = 0
        applied: list[float] = []
        commands: list[float] = []
        if k and v_made != v_before:
            commands = [v_before] * (missing + 1)
            controller.start_from(v_before)
        complete = bool(reports) and len(reports[k]) == missing + 1
        if k and trust.note(complete) and complete:
            known, scale = controller.estimator.estimate, controller.command_of(1.0)
            if origin.changed_by(reports[k][-1], v_before / scale, known):
                # As in the loop: what was learned from them so far goes.
                before, controller = controller, build_controller(p, origin.before)
                controller.go_on_from(before)
                controller.start_from(v_before)
                missing, commands = 0, []
            else:
                applied = [each - origin.value for each in reports[k]]
        step = controller.step(y, y_m, missing, applied, commands=commands)
        controller.refine()
        rows[k] = row_of(t[k], y, v, np.nan, step, controller.estimator)
        v_before, v_made = v, step.v
        if on_sample is not None:
            on_sample(k)
    for name in ('u', 'true_m', 'true_c_r', 'true_c_l'):  # what no controller can say
        rows[:, COLUMNS.index(name)] = recorded.column(name)
    return RunRecord(
        rows, recorded.sample_period, recorded.lost_samples,
        learned_model_of(controller.estimator, p),
    )


def parting(recorded: RunRecord, replayed: RunRecord) -> Parting | None:
    """Where the estimates differ by a bit for the first time; None where they never do."""
    compared = ('m', 'c_r', 'c_l')
    own = np.column_stack([recorded.column(name) for name in compared])
    again = np.column_stack([replayed.column(name) for name in compared])
    differs = (own != again) & ~(np.isnan(own) & np.isnan(again)) & ~np.isnan(own)
    rows = np.flatnonzero(differs.any(axis=1))
    if not len(rows):
        return None
    k = int(rows[0])
    i = int(np.argmax(differs[k]))
    std = np.column_stack([recorded.column(f'std_{name}') for name in compared])
    scale = np.where(np.isfinite(std) & (std > 0.0), std, np.maximum(np.abs(own), 1e-300))
    return Parting(
        k, float(recorded.column('t')[k]), compared[i], float(own[k, i]), float(again[k, i]),
        float(np.nanmax(np.where(differs, np.abs(own - again) / scale, 0.0))),
    )
