"""Runs of the closed loop for the estimation benchmark: one function per process of the pool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import sin

import numpy as np
from numpy.typing import NDArray

from accuracy.cramer_rao import cramer_rao
from accuracy.random_cases import Case, bound_of, random_case, uncertain_case
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import ClosedLoop, build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord

Array = NDArray[np.float64]

NAMES = ('m', 'c_r', 'c_l')
EXACT = {'plant.uncertainty': 0.0}  # the promises beside the bound hold where G is known
MARKS_S = (0.5, 1.0, 2.0, 6.0)
QUIET_NOISE = 1e-4  # times the noise of a random case
FIVE = 5.0  # published deviations beyond which an estimate is wrong


@dataclass(frozen=True)
class SeedJob:
    """The paper's example with changes, looked at after marks_s [s]."""

    seed: int
    marks_s: tuple[float, ...] = MARKS_S
    changes: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class SeedResult:
    """error, bound: shape (marks, 3). nees: normalised by the whole covariance, shape (marks,).

    nees is nan where nothing was published yet.
    """

    seed: int
    error: Array
    bound: Array
    nees: Array
    status: NDArray[np.int_]


@dataclass(frozen=True)
class CaseResult:
    """End of a random case: relative errors (3,), relative bounds (3,), and what was wrong.

    deviations: largest error over its published deviation while tracking, at the end and of all
    samples; 0 where it never tracked. overconfident: share of the samples beyond five.
    """

    seed: int
    kind: str
    error: Array
    bound: Array
    swing: float  # of v, in gaps
    status: int
    trouble: str
    deviations: tuple[float, float] = (0.0, 0.0)
    overconfident: float = 0.0


def estimates(run: RunRecord) -> Array:
    """Estimates of (m, c_r, c_l), shape (N, 3)."""
    return np.column_stack([run.column(name) for name in NAMES])


def truths(run: RunRecord) -> Array:
    """True (m, c_r, c_l), shape (N, 3)."""
    return np.column_stack([run.column(f'true_{name}') for name in NAMES])


def relative_errors(run: RunRecord) -> Array:
    """|estimate / truth - 1|, shape (N, 3)."""
    return np.abs(estimates(run) / truths(run) - 1.0)


def run_seed(job: SeedJob) -> SeedResult:
    """Simulate one seed and compare with the bound at every mark."""
    p = Parameters({**EXACT, 'seed': job.seed, **job.changes})
    period = p.get_float('sample_period')
    marks = [round(mark / period) for mark in job.marks_s]
    loop = build_closed_loop(p)
    covariances: dict[int, Array | None] = {}

    def keep(k: int) -> None:
        if k in marks:
            covariances[k] = loop.controller.estimator.covariance

    run = loop.run(max(marks) + 1, keep)
    index = np.rint(run.column('t') / period).astype(int)
    rows = [int(np.searchsorted(index, mark, side='right')) - 1 for mark in marks]
    truth = p.get_float('backlash.m'), p.get_float('backlash.c_r'), p.get_float('backlash.c_l')
    error = estimates(run)[rows] - truth
    # A lost sample leaves the command before it in force.
    v = run.column('v')[np.searchsorted(index, np.arange(max(marks)), side='right') - 1]
    received = np.isin(np.arange(max(marks) + 1), index)
    bound = np.array([
        cramer_rao(
            v[:mark], np.array(p.get_floats('plant.numerator')),
            np.array(p.get_floats('plant.denominator')), truth, p.get_float('output_noise_std'),
            received[:mark + 1], p.get_float('backlash.initial_u'),
        ) for mark in marks
    ])
    nees = np.array([_nees(e, covariances[k]) for e, k in zip(error, marks, strict=True)])
    return SeedResult(job.seed, error, bound, nees, run.column('status')[rows].astype(int))


def _nees(error: Array, cov: Array | None) -> float:
    return float('nan') if cov is None else float(error @ np.linalg.solve(cov, error))


def run_quiet_case(seed: int) -> CaseResult:
    """The random case with next to no noise, which the estimator is told."""
    noise = QUIET_NOISE * random_case(seed).parameters.get_float('output_noise_std')
    return _run_case(random_case(
        seed, **{'output_noise_std': noise, 'estimator.output_noise_std': noise}
    ))


def run_random_case(seed: int) -> CaseResult:
    """Simulate one random case for three periods."""
    return _run_case(random_case(seed))


def run_uncertain_case(seed: int) -> CaseResult:
    """The random case with a plant that is another one than G."""
    return _run_case(uncertain_case(seed))


def _run_case(case: Case) -> CaseResult:
    seed, p = case.seed, case.parameters
    truth = p.get_float('backlash.m'), p.get_float('backlash.c_r'), p.get_float('backlash.c_l')
    try:
        run = build_closed_loop(p).run(case.samples + 1)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        nothing = np.full(3, np.inf)
        return CaseResult(seed, case.kind, nothing, np.zeros(3), 0.0, 0, f'broke off: {error}')
    v = run.column('v')
    bound = bound_of(p, v[:-1])
    off = _deviations(run)
    return CaseResult(
        seed, case.kind, relative_errors(run)[-1], bound,
        float(np.ptp(v[len(v) * 2 // 3:])) / (truth[1] - truth[2]),
        int(run.column('status')[-1]), _trouble(run, p), (float(off[-1]), float(off.max())),
        float(np.mean(off > FIVE)),
    )


def _deviations(run: RunRecord) -> Array:
    """Largest error over its published deviation of every sample, 0 where it does not track."""
    std = np.column_stack([run.column(f'std_{name}') for name in NAMES])
    off = (np.abs(estimates(run) - truths(run)) / std).max(axis=1)
    return np.where(run.column('status') == Status.TRACKING, off, 0.0)


def _trouble(run: RunRecord, p: Parameters) -> str:
    values = estimates(run)
    if not (np.isfinite(values).all() and np.isfinite(run.column('v')).all()):
        return 'not finite'
    bounds = np.array([p.get_pair(f'estimator.bounds.{name}') for name in NAMES])
    if (values < bounds[:, 0]).any() or (values > bounds[:, 1]).any():
        return 'outside the bounds'
    return ''


@dataclass(frozen=True)
class WearResult:
    """Largest relative errors of a run with wear: m from 1 s on, c_r away from the second
    after its step, (before the step, after it)."""

    seed: int
    m: float
    c_r: tuple[float, float]


STEP_S = 10.0


def run_wear(job: SeedJob) -> WearResult:
    """m falls by 1 % a second and c_r steps from 3 to 4 at 10 s; 20 s."""
    run = build_closed_loop(Parameters({
        **EXACT, 'seed': job.seed, 'backlash.rate': (-0.013, 0.0, 0.0),
        'backlash.jump_time': STEP_S, 'backlash.jump': (0.0, 1.0, 0.0), **job.changes,
    })).run(2000)
    t, error = run.column('t'), relative_errors(run)
    return WearResult(
        job.seed, float(error[t >= 1.0, 0].max()),
        (float(error[(t >= 1.0) & (t < STEP_S), 1].max()),
         float(error[t >= STEP_S + 1.0, 1].max())),
    )


@dataclass(frozen=True)
class HourResult:
    """An hour without excitation: when it froze, what moved afterwards, and the covariance."""

    what: str
    frozen_after_s: float
    always_frozen: bool  # as not excited, from then to the end
    moved: float  # largest change of an estimate since then
    finite: bool
    learned: Array  # relative errors at the end


QUIET_FROM_S = 3.0
QUIET = ('never excited', 'v limited to +-2 from 3 s on', 'at rest from 3 s on')


def run_hour(job: tuple[str, int]) -> HourResult:
    """One of QUIET for so many samples: v does not swing over the gap (any more)."""
    what, samples = job
    changes: dict[str, dict[str, object]] = {
        QUIET[0]: {'amplitude': 0.3}, QUIET[2]: {'proportional.f': 0.0},
    }
    loop = build_closed_loop(Parameters({
        **EXACT, 'output_noise_std': 1e-3, **changes.get(what, {}),
    }))

    def limit(k: int) -> None:
        if k * loop.sample_period == QUIET_FROM_S:
            loop.controller.limits = Limits(-2.0, 2.0)

    if what == QUIET[2]:
        loop.reference = lambda t: 10.0 * sin(12.6 * min(t, QUIET_FROM_S))
    run = loop.run(samples, limit if what == QUIET[1] else None)
    status, values = run.column('status').astype(int), estimates(run)
    start = 0 if what == QUIET[0] else round(QUIET_FROM_S / run.sample_period)
    frozen = np.flatnonzero(status[start:] == Status.NOT_EXCITED)
    first = start + (int(frozen[0]) if frozen.size else samples - 1 - start)
    return HourResult(
        what, (first - start) * run.sample_period,
        bool(frozen.size) and bool(np.all(status[first:] == Status.NOT_EXCITED)),
        float(np.abs(values[first:] - values[first]).max()), _covariances_finite(loop),
        relative_errors(run)[-1],
    )


def _covariances_finite(loop: ClosedLoop) -> bool:
    found = loop.controller.estimator.covariance
    return found is None or bool(np.isfinite(found).all())
