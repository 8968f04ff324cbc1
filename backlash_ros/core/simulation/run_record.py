"""A run, simulated or recorded: a row per sample, the G that was learned, figures of merit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.estimate import Estimate, was_given
from backlash_ros.core.law import Law
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.scenario import build_model

COLUMNS = (
    't', 'y_m', 'y', 'u_d', 'v', 'u', 'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l',
    'u_hat', 'innovation', 'status', 'latency_s', 'true_m', 'true_c_r', 'true_c_l',
)
SETTLING_TOLERANCE = 0.01  # of the true value
# Frequencies at which the response of G is judged, as fractions of the sampling rate: from slow
# motion to where little of the response is left.
FREQUENCIES: tuple[float, ...] = tuple(np.geomspace(0.01, 0.2, 5).tolist())
# Labels of LearnedModel, in the order of `controller/model`.
MODEL_LABELS = (
    'numerator', 'denominator', 'delay_samples',
    *(f'response_std_at_{share:.4g}_of_sampling_rate' for share in FREQUENCIES),
    'noise_ratio', 'unexplained',
)
# G(z) = z^-delay_samples numerator / denominator, in descending powers of z, by MODEL_LABELS.
# response_std: relative deviation |dG/G| of the true response from it; the gain at rest is part of
# m. noise_ratio, unexplained: as in LawReport. These are nan where the law does not learn them.
LearnedModel = Mapping[str, tuple[float, ...]]


def stated_deviations(e: Estimate) -> tuple[float, float, float]:
    """Return the std of m, c_r, c_l to publish and record: nan for constants that were given."""
    return (nan, nan, nan) if was_given(e) else (e.std_m, e.std_c_r, e.std_c_l)


def row_of(
    t: float, y: float, v: float, u: float, step: ControlStep, law: Law,
    truth: tuple[float, float, float] = (nan, nan, nan),
) -> tuple[float, ...]:
    """Return the row of a sample; v: the one that was sent, u and truth: nan if unknown."""
    e = step.estimate
    return (
        t, step.y_m, y, step.u_d, v, u, e.m, e.c_r, e.c_l, e.f, *stated_deviations(e), law.u_hat,
        law.innovation, e.status, nan, *truth,
    )


def learned_model_of(law: Law, p: Parameters) -> LearnedModel:
    """Return the G that a law has learned so far, or that of the parameters if it learns none."""
    learned, report = law.learned_model, law.report
    model = build_model(p) if learned is None else learned.transfer_function
    response_std = law.response_std(np.exp(2j * np.pi * np.array(FREQUENCIES)))
    numerator, denominator, delay = model.without_delay()
    numbers = [delay, *response_std.tolist(), report.noise_ratio, report.unexplained]
    return dict(zip(MODEL_LABELS, (
        tuple(numerator), tuple(denominator), *((float(number),) for number in numbers),
    ), strict=True))


def complete_model(fields: Mapping[str, Sequence[float]]) -> LearnedModel | None:
    """Return the model of a message or a file, or None if numbers are missing."""
    if not all(fields.get(label) for label in MODEL_LABELS):
        return None
    return {label: tuple(fields[label]) for label in MODEL_LABELS}


@dataclass(frozen=True)
class RunRecord:
    """rows: shape (N, len(COLUMNS)), one per sample that reached the controller.

    t [s] counts sample periods from the first one. u and true_* are nan without a simulation.
    Estimates are those that v was computed with. latency_s: from the departure of y(k) at the
    driver to that of v(k) at the controller, nan in a simulation. lost_samples: outputs that never
    arrived. learned: the G that the controller had learned at the end, None if not known.
    """

    rows: Array
    sample_period: float
    lost_samples: int = 0
    learned: LearnedModel | None = None

    def column(self, name: str) -> Array:
        return self.rows[:, COLUMNS.index(name)]

    @property
    def samples(self) -> int:
        return len(self.rows)

    @property
    def has_estimates(self) -> bool:
        """Whether it is the run of a controller, not just a log of v and y."""
        return bool(np.isfinite(self.column('m')).any())

    @property
    def has_truth(self) -> bool:
        return bool(np.isfinite(self.column('true_m')).all()) and self.samples > 0


def settling_time(t: Array, estimate: Array, truth: Array) -> float | None:
    """Return the first time [s] from which an estimate stays within 1 % of the truth, or None."""
    # An estimate that is not a number counts as outside.
    inside = np.abs(estimate - truth) <= SETTLING_TOLERANCE * np.abs(truth)
    settled = np.logical_and.accumulate(inside[::-1])[::-1]
    return float(t[settled][0]) if settled.any() else None


def control_error(run: RunRecord) -> Array:
    """Return e = u - u_d (3.4) of each sample, shape (N,); nan where u is unknown."""
    return run.column('u') - run.column('u_d')


def control_error_rms(run: RunRecord) -> float | None:
    """Return the RMS of e over the last second [unit of u]; None without the true u."""
    e = control_error(run)[run.column('t') > run.column('t')[-1:] - 1.0]
    e = e[np.isfinite(e)]
    return float(np.sqrt(np.mean(e**2))) if e.size else None


def delayed_reference(run: RunRecord, delay: int) -> Array:
    """Return y_m delayed by `delay` sample periods, with y(0) before it begins, shape (N,)."""
    t, y_m = run.column('t'), run.column('y_m')
    newest = np.searchsorted(t, t - (delay - 0.5) * run.sample_period, side='right') - 1
    return np.where(newest >= 0, y_m[np.maximum(newest, 0)], run.column('y')[:1])


def delayed_tracking_error_rms(run: RunRecord, delay: int, since: float = 0.0) -> float | None:
    """Return RMS of y - y_m(k - delay) over that of y_m, from `since` [s] on; None for y_m = 0."""
    rows = run.column('t') >= since
    reference = delayed_reference(run, delay)[rows]
    if not np.any(reference):
        return None
    error = run.column('y')[rows] - reference
    return float(np.sqrt(np.mean(error**2) / np.mean(reference**2)))


def turns(values: Array, least: float) -> int:
    """Count how often a signal turns back by more than `least` from its extreme."""
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
    """Return the turns of v by over half the gap per reversal of y_m, from `since` [s] on.

    None without a true gap or without a reversal.
    """
    rows = run.column('t') >= since
    gap = (run.column('true_c_r') - run.column('true_c_l'))[rows]
    reversals = turns(run.column('y_m')[rows], 0.0)
    if reversals == 0 or not np.all(np.isfinite(gap)) or float(gap.max()) < 1e-6:
        return None
    return turns(run.column('v')[rows], 0.5 * float(gap.max())) / reversals
