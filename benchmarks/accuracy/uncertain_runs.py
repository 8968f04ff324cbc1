"""One run with a plant that differs from the one that is told, and what it came to."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, nan

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from accuracy.coasting_load import CoastingLoad
from accuracy.uncertain_cases import Job
from backlash_ros.core.assembly import build_plant, build_true_model
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.reference.signal import ReferenceSignal
from backlash_ros.core.simulation.closed_loop import ClosedLoop, build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord

Array = NDArray[np.float64]

NAMES = ('m', 'c_r', 'c_l')
MARKS_S = (2.0, 6.0, 10.0)
ACQUIRED_S = 0.5  # from here on the loop is to be tracking
FOLLOWS_S = 4.0  # from here on the error of y is judged
RESTS_S = 6.0  # from here on v is to stand still where the reference is frozen
DEVIATIONS, WRONG = 4.0, 5.0  # standard deviations within which errors are to be, and beyond which
SWAP = 5  # samples from a swap of G on whose moves of v are judged
COUNTED = 1.0  # seconds before it whose moves of v they are compared with


@dataclass(frozen=True)
class Figures:
    """What a run came to.

    errors: of (m, c_r, c_l) relative to the truth at MARKS_S, shape (marks, 3), nan beyond the end.
    tracking: share of the samples after ACQUIRED_S with that status. normalised: errors over
    published deviations of every sample after the first with status TRACKING, shape (N, 3).
    wrong_s: longest time with status TRACKING and an error of more than WRONG deviations.
    following: RMS of y, before the sensor, against the delayed reference [unit of y].
    moving: share of the samples after RESTS_S in which v moves. swaps: of G; worst_swap: largest
    move of v at one of them over the largest in the second before, nan without any, and when that
    was [s]. moves: of v, the first one from 0, shape (N,).
    """

    name: str
    seed: int
    errors: Array = field(default_factory=lambda: np.full((len(MARKS_S), 3), inf))
    tracking: float = 0.0
    normalised: Array = field(default_factory=lambda: np.zeros((0, 3)))
    wrong_s: float = inf
    status: Status = Status.ACQUIRING
    following: float = inf
    moving: float = 1.0
    swaps: int = 0
    worst_swap: float = nan
    worst_swap_s: float = nan
    moves: Array = field(default_factory=lambda: np.zeros(0))
    problem: str = ''


class Watched:
    """A plant of which every v and u is kept."""

    def __init__(self, plant: object) -> None:
        self._plant = plant
        self.v: list[float] = []
        self.u: list[float] = []

    def __getattr__(self, name: str) -> object:
        return getattr(self._plant, name)

    def step(self, v: float) -> float:
        """Apply v."""
        u = self._plant.step(v)
        self.v.append(v)
        self.u.append(u)
        return u


def run_job(job: Job) -> Figures:
    """Simulate; a run that breaks off is a result as well."""
    p = job.parameters
    loop = build_closed_loop(p)
    loop.plant = plant = Watched(_plant(job))
    if job.reference:
        period = p.get_float('sample_period')
        loop.reference = ReferenceSignal('file', sample_period=period, samples=job.reference)
    models: list[object] = []  # in whose coordinates the state stands, at every sample
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            run = loop.run(job.samples, lambda _: models.append(
                getattr(loop.controller.estimator, 'model', None)
            ))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return Figures(job.name, job.seed, problem=str(error))
    return _figures(job, loop, run, plant, models)


def _plant(job: Job) -> object:
    p = job.parameters
    if not job.coasts:
        return build_plant(p)
    return CoastingLoad(
        build_plant(p).backlash,
        p.get_float('sample_period'),
        quantum=p.get_float('output_quantum'),
        **job.coasts,
    )


def _figures(
    job: Job, loop: ClosedLoop, run: RunRecord, plant: Watched, models: list[object],
) -> Figures:
    t, status = run.column('t'), run.column('status')
    estimates, truths, deviations = (
        np.column_stack([run.column(f'{prefix}{name}') for name in NAMES])
        for prefix in ('', 'true_', 'std_')
    )
    error = estimates - truths
    half = 0.5 * run.sample_period
    rows = [int(np.searchsorted(t, mark + half)) - 1 for mark in MARKS_S]
    errors = np.abs(error / truths)[rows]
    errors[[mark > t[-1] + half for mark in MARKS_S]] = nan
    is_tracking = status == Status.TRACKING
    learned = np.cumsum(is_tracking) > 0
    with np.errstate(divide='ignore', invalid='ignore'):
        normalised = np.abs(error) / deviations
    wrong = is_tracking & ~(normalised <= WRONG).all(axis=1)
    v = np.array(plant.v)
    moves = np.abs(np.diff(v, prepend=0.0))
    swaps, worst, worst_s = swaps_of(models, moves, run.sample_period)
    begin = round(RESTS_S / run.sample_period)
    return Figures(
        job.name, job.seed, errors, float(is_tracking[t >= ACQUIRED_S].mean()),
        normalised[learned & np.isfinite(deviations).all(axis=1)],
        longest(wrong) * run.sample_period, Status(int(status[-1])),
        following(job.parameters, loop, np.array(plant.u)),
        float(np.mean(np.diff(v[begin:]) != 0.0)) if len(v) > begin + 1 else nan,
        swaps, worst, worst_s, moves,
    )


def following(p: Parameters, loop: ClosedLoop, u: Array) -> float:
    """RMS of y, before the sensor, minus the delayed reference from FOLLOWS_S on."""
    true, delay = build_true_model(p), loop.controller.structure.delay
    y = lfilter(true.numerator, true.denominator, u)
    begin = round(FOLLOWS_S / loop.sample_period)
    if len(u) <= begin:
        return nan
    reference = [loop.reference((k - delay) * loop.sample_period) for k in range(begin, len(u))]
    return float(np.sqrt(np.mean((y[begin:] - reference) ** 2)))


def larger_moves(moves: Array, k: int, period_s: float) -> float:
    """Largest move of v from sample k on over the largest in the second before."""
    second = round(COUNTED / period_s)
    return float(moves[k:k + SWAP].max() / max(moves[max(k - second, 0):k].max(), 1e-12))


def longest(flags: NDArray[np.bool_]) -> int:
    """Length of the longest row of true ones."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return int(np.max(ends[1::2] - ends[::2], initial=0))


def swaps_of(models: list[object], moves: Array, period_s: float) -> tuple[int, float, float]:
    """How many swaps of G there were, and the worst `larger_moves` at one of them, when [s].

    One that no move of v has followed yet does not count.
    """
    at = [k for k in range(1, min(len(models), len(moves))) if models[k] is not models[k - 1]]
    ratios = [larger_moves(moves, k, period_s) for k in at]
    worst = int(np.argmax(ratios)) if at else 0
    return (len(at), ratios[worst], at[worst] * period_s) if at else (0, nan, nan)
