"""The whole loop without ROS: reference, controller and simulated plant, or a recorded run.

A replay computes a command from every recorded y and y_m. It learns from the v that was recorded:
the reported one if the loop would have believed it, else the command.
"""

from array import array
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.control.controller import LONGEST_GAP
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.loop.command_history import ReportOrigin, ReportTrust, report_use
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, learned_model_of, row_of


class ClosedLoop:
    """Controller, plant and reference stepped together; p.seed also decides which y are lost."""

    def __init__(self, p: Parameters) -> None:
        self.p, self.controller, self.plant = p, build_controller(p), build_plant(p)
        self.reference: Callable[[float], float] = build_reference(p)
        self._rng = np.random.default_rng([p.seed, 1])

    def run(self, samples: int) -> RunRecord:
        """Simulate and return every signal."""
        p, controller, plant = self.p, self.controller, self.plant
        values = array('d')  # row by row, which is faster than with NumPy
        lost, v = 0, 0.0
        for k in range(samples):
            t = k * p.sample_period
            y = plant.measure()
            if k > 0 and p.output_loss > 0.0 and self._rng.random() < p.output_loss:
                lost += 1
                plant.step(v)
            else:
                step = controller.step(y, self.reference(t), lost)
                controller.refine()
                lost, v = 0, step.v
                u, truth = plant.step(v), plant.backlash
                values.extend(row_of(t, y, v, u, step, controller.estimator,
                                     (truth.m, truth.c_r, truth.c_l)))
        return RunRecord(
            np.array(values).reshape(-1, len(COLUMNS)), p.sample_period,
            controller.lost_samples + lost, learned_model_of(controller.estimator, p))


build_closed_loop = ClosedLoop  # the public name, as of all that is built from parameters


def replay(
    recorded: RunRecord, p: Parameters, reports: Sequence[Sequence[float]] = (),
) -> RunRecord:
    """Feed y, y_m, v and losses of a record to a controller; return what it would have done.

    reports: for each row the v that the driver reported since the row before it. Raises ValueError
    for rows that are not finite, ParameterError for parameters that contradict each other.
    """
    t = recorded.column('t')
    columns = [recorded.column(name).tolist() for name in ('y_m', 'y', 'v')]
    steps = np.diff(t, prepend=t[:1]) / recorded.sample_period
    lost = np.maximum(np.round(steps).astype(int) - 1, 0).tolist()
    controller = build_controller(p)
    rows = np.full((recorded.samples, len(COLUMNS)), np.nan)
    trust, origin = ReportTrust(report_use(p)), ReportOrigin()
    v_before = v_made = 0.0
    for k, (missing, y_m, y, v) in enumerate(zip(lost, *columns, strict=True)):
        if not (plausible(y_m) and plausible(y) and plausible(v)):
            raise ValueError(f't={t[k]:g}: y_m={y_m!r}, y={y!r} and v={v!r} must be finite')
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
                # As in the loop, what was learned from the reports so far is dropped.
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
    for name in ('u', 'true_m', 'true_c_r', 'true_c_l'):  # what no controller knows
        rows[:, COLUMNS.index(name)] = recorded.column(name)
    return RunRecord(rows, recorded.sample_period, recorded.lost_samples,
                     learned_model_of(controller.estimator, p))


class Parting(NamedTuple):
    """First time [s] at which a replay differs from the run, and in which estimate.

    largest: difference over all rows, in standard deviations where they are known, else relative.
    """

    t: float
    name: str
    recorded: float
    replayed: float
    largest: float


def parting(recorded: RunRecord, replayed: RunRecord) -> Parting | None:
    """Return where the estimates first differ, if only by a bit, or None if they never do."""
    first = COLUMNS.index('m')
    own, again = recorded.rows[:, first:first + 3], replayed.rows[:, first:first + 3]
    differs = (own != again) & ~np.isnan(own)
    if not differs.any():
        return None
    k, i = (int(index) for index in np.argwhere(differs)[0])
    std = recorded.rows[:, COLUMNS.index('std_m'):][:, :3]
    scale = np.where(np.isfinite(std) & (std > 0.0), std, np.maximum(np.abs(own), 1e-300))
    return Parting(
        float(recorded.column('t')[k]), COLUMNS[first + i], float(own[k, i]),
        float(again[k, i]), float(np.nanmax(np.where(differs, np.abs(own - again) / scale, 0.0))),
    )
