"""Rows of simulated loops: what is learned beside the bound, and where the plant is not as told."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import copysign, pi
from typing import Any, NamedTuple

import numpy as np
from cases.loops import motor, random_backlash
from cases.random_cases import bound_of, cramer_rao, random_case, uncertain_case
from contract.figures import (
    Array,
    Figure,
    Judged,
    by_group,
    figure,
    figures_of,
    judged,
    rms,
    share,
    upper,
)

from backlash_ros.core import Parameters, Status, build_closed_loop, build_plant
from backlash_ros.core.plant.backlash import Backlash

STEP_S = 0.25e-3  # of the integration


class CoastingLoad:
    """A load that goes on within the gap, with the interface of SimulatedPlant.

    J x'' = k z - b x' - friction,  z = p - x - m c_r if > 0,  p - x - m c_l if < 0,  else 0
    with p = m v, w^2 = k/J and 2 d w = b/J; v moves evenly within a sample.
    frequency: of the contact [Hz]. damping: ratio d of the viscous friction. dry: deceleration by
    dry friction [unit of y / s^2]. quantum: of the sensor, 0 for none [unit of y].
    """

    def __init__(
        self, backlash: Backlash, period_s: float, frequency: float = 20.0, damping: float = 0.5,
        dry: float = 0.0, quantum: float = 0.0,
    ) -> None:
        self.backlash = backlash  # what a play between the same parts would let through
        self.sample = 0
        self._stiffness = (2.0 * pi * frequency) ** 2
        self._viscous = 4.0 * pi * damping * frequency
        self._dry, self._quantum = dry, quantum
        self._steps = round(period_s / STEP_S)
        self._v = self._x = self._speed = 0.0

    def measure(self) -> float:
        return self._quantum * round(self._x / self._quantum) if self._quantum else self._x

    def step(self, v: float) -> float:
        """Move the input to v over one sample period; return the output of a play."""
        for i in range(1, self._steps + 1):
            self._advance(self._v + (v - self._v) * i / self._steps)
        self._v = v
        self.sample += 1
        return self.backlash.step(v)

    def _advance(self, v: float) -> None:
        play = self.backlash
        right, left = play.m * (v - play.c_r) - self._x, play.m * (v - play.c_l) - self._x
        depth = right if right > 0.0 else min(left, 0.0)
        push = self._stiffness * depth - self._viscous * self._speed
        if self._speed == 0.0 and abs(push) <= self._dry:
            return
        moved = self._speed + STEP_S * (push - copysign(self._dry, self._speed or push))
        # Dry friction stops the load and does not turn it round.
        self._speed = 0.0 if moved * self._speed < 0.0 and abs(push) <= self._dry else moved
        self._x += STEP_S * self._speed


Changes = dict[str, Any]

PAPER: Changes = {'plant.uncertainty': 0.0}
BROKEN = (ValueError, ArithmeticError, np.linalg.LinAlgError)


@dataclass(frozen=True)
class Job:
    """One loop. group: that its figures go into. coasts: arguments of a CoastingLoad, if any."""

    group: str
    changes: Changes
    seconds: float
    coasts: Mapping[str, float] | None = None
    marks_s: tuple[float, ...] = ()  # at which the Cramér-Rao bound is wanted


@dataclass(frozen=True)
class Outcome:
    """What came of a job. error, bound: of (m, c_r, c_l) at its marks, shape (marks, 3).

    follows: RMS of y minus the reference it is to follow, over that of the reference, in the last
    half.
    """

    group: str
    judged: Judged | None
    error: Array = field(default_factory=lambda: np.zeros((0, 3)))
    bound: Array = field(default_factory=lambda: np.zeros((0, 3)))
    follows: float = 1e3


def run_job(job: Job) -> Outcome:
    """Simulate; a run that breaks off is a result as well."""
    p = Parameters(job.changes)
    period = p.sample_period
    loop = build_closed_loop(p)
    if job.coasts is not None:
        loop.plant = CoastingLoad(  # type: ignore[assignment]
            build_plant(p).backlash, period, quantum=p.output_quantum, **job.coasts)
    disturbance: list[float] = [0.0]  # what is added to u moves both crossings
    step = loop.plant.step

    def recorded(v: float) -> float:
        if job.coasts is None:
            disturbance.append(loop.plant.disturbance)
        return step(v)

    loop.plant.step = recorded  # type: ignore[method-assign]
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            run = loop.run(round(job.seconds / period) + 1)
    except BROKEN:
        return Outcome(job.group, None)
    rows = np.round(run.column('t') / period).astype(int)  # a lost y has none
    added = np.array(disturbance)[np.minimum(rows, len(disturbance) - 1)]
    return Outcome(job.group, judged(run, added / p.backlash.m),
                   *_beside_bound(p, run, job.marks_s), _follows(p, run))


def _follows(p: Parameters, run: Any) -> float:
    delay = p.tracking.preview if p.structure == 'tracking' else 0
    y, y_m = run.column('y'), run.column('y_m')
    half = len(y) // 2
    wanted = y_m[half - delay:len(y) - delay]
    return min(rms(y[half:] - wanted) / max(rms(wanted), 1e-12), 1e3)


def _beside_bound(p: Parameters, run: Any, marks_s: Sequence[float]) -> tuple[Array, Array]:
    truth = p.backlash.m, p.backlash.c_r, p.backlash.c_l
    period = p.sample_period
    index = np.rint(run.column('t') / period).astype(int)
    errors, bounds = [], []
    for mark in (round(mark / period) for mark in marks_s):
        row = int(np.searchsorted(index, mark, side='right')) - 1
        errors.append([run.column(name)[row] for name in ('m', 'c_r', 'c_l')] - np.array(truth))
        # A lost sample leaves the command before it in force.
        v = run.column('v')[np.searchsorted(index, np.arange(mark), side='right') - 1]
        bounds.append(cramer_rao(
            v, np.array(p.plant.numerator), np.array(p.plant.denominator), truth,
            p.output_noise_std, np.isin(np.arange(mark + 1), index), p.backlash.initial_u))
    return np.array(errors).reshape(-1, 3), np.array(bounds).reshape(-1, 3)


# The paper's example with exact G, beside the Cramér-Rao bound; and with samples that are lost.
BOUND_MARKS_S = (1.0, 2.0, 6.0)


def bound_jobs(scale: float) -> list[Job]:
    return [Job(f'noise {noise:g}', {**PAPER, 'output_noise_std': noise, 'seed': seed}, 6.0,
                marks_s=BOUND_MARKS_S)
            for noise in (1e-4, 1e-3, 1e-2) for seed in range(1, 1 + round(50 * scale))]


def losses_jobs(scale: float) -> list[Job]:
    """A fifth of y is lost: the paper's example, and the geared motor with a G that is off."""
    seeds = range(1, 1 + round(40 * scale))
    lossy = {'output_loss': 0.2}
    return [
        *(Job('paper', {**PAPER, **lossy, 'output_noise_std': 1e-3, 'seed': seed}, 6.0,
              marks_s=BOUND_MARKS_S) for seed in seeds),
        *(Job('geared motor, ω × 1.2', {
            **motor(), **random_backlash(seed), **lossy, 'truth.scale_frequency': 1.2,
            'seed': seed}, 10.0) for seed in seeds[::2]),
    ]


def bound_figures(outcomes: Sequence[Outcome]) -> dict[str, Figure]:
    """Errors over the bound where there is one, in quadratic mean over seeds and parameters."""
    def of_group(of: Sequence[Outcome]) -> dict[str, Figure]:
        found = figures_of([one.judged for one in of], (0.5, 2.0, 6.0))
        for i, mark in enumerate(BOUND_MARKS_S if len(of[0].bound) else ()):
            ratios = [rms(one.error[i] / one.bound[i]) if len(one.bound) else 1e3 for one in of]
            found[f'error / bound at {mark:g} s, RMS'] = figure(ratios, rms)
        return found

    return by_group(outcomes, of_group)


# The geared motor with plants that are not the nominal one.
DIFFERENT: dict[str, Changes] = {
    'exact': {},
    **{f'ω × {f:g}': {'truth.scale_frequency': f} for f in (0.8, 0.9, 0.98, 1.02, 1.1, 1.2)},
    **{f'd × {f:g}': {'truth.scale_damping': f} for f in (0.8, 1.2)},
    **{f'lag {1e3 * s:g} ms': {'truth.extra_lag': s} for s in (0.001, 0.005)},
    'delay 1': {'truth.delay_samples': 1},
    'ω × 0.8, d × 1.2': {'truth.scale_frequency': 0.8, 'truth.scale_damping': 1.2},
    'ω × 1.2, lag 5 ms': {'truth.scale_frequency': 1.2, 'truth.extra_lag': 0.005},
    'ω × 0.9, delay 1': {'truth.scale_frequency': 0.9, 'truth.delay_samples': 1},
}
FAR_OFF: dict[str, Changes] = {
    'ω × 0.5': {'truth.scale_frequency': 0.5}, 'ω × 1.5': {'truth.scale_frequency': 1.5},
    'lag 20 ms': {'truth.extra_lag': 0.02},
}
OTHERWISE: dict[str, Changes] = {
    'triangle': {'waveform': 'triangle'}, 'square': {'waveform': 'square'},
    'chirp': {'waveform': 'chirp', 'frequency_start': 0.63, 'frequency': 18.8},
    'limits': {'control.min': -6.0, 'control.max': 6.0, 'control.rate_max': 60.0},
    'noise told × 0.1': {'estimator.output_noise_std': 1.1e-5},
    'noise told × 10': {'estimator.output_noise_std': 1.1e-3},
    'coarse encoder': {'output_quantum': 8e-3, 'estimator.output_noise_std': 2.3e-3},
}


def plants_jobs(structure: str, scale: float) -> list[Job]:
    """Every plant with a few backlashes, and other motions and sensors with two of them."""
    seeds = range(1, 1 + max(round(4 * scale), 1))
    cases = {
        'G off': DIFFERENT, 'G far off': FAR_OFF,
        'other motions and sensors': {
            f'{motion}; {plant}': {**change, **DIFFERENT[plant]}
            for (motion, change), plant in product(OTHERWISE.items(), ('exact', 'ω × 1.2'))
        },
    }
    return [Job(group, {**motor(), **random_backlash(seed), **change, 'structure': structure,
                        'seed': seed}, 10.0)
            for group, plants in cases.items() for change in plants.values() for seed in seeds]


def plants_figures(outcomes: Sequence[Outcome]) -> dict[str, Figure]:
    return by_group(outcomes, lambda of: {
        **figures_of([one.judged for one in of], (0.5, 2.0, 10.0)),
        'y follows, median': figure([one.follows for one in of]),
        'y follows, 90 %': figure([one.follows for one in of], upper),
    })


# Random plants, gaps, first guesses and references, three periods each.
RANDOM_KINDS = ('exact', 'next to no noise', 'time constants 10 % off')


class RandomOutcome(NamedTuple):
    """Largest error of m, c_r, c_l over its bound and relative, at the end; judged as others."""

    group: str
    over_bound: float
    relative: float
    judged: Judged | None


def random_jobs(scale: float) -> list[tuple[str, int]]:
    return [(kind, seed) for kind, count in zip(RANDOM_KINDS, (60, 20, 60), strict=True)
            for seed in range(1, 1 + round(scale * count))]


def run_random(job: tuple[str, int]) -> RandomOutcome:
    kind, seed = job
    case = random_case(seed) if kind != RANDOM_KINDS[2] else uncertain_case(seed)
    p = case.parameters
    if kind == RANDOM_KINDS[1]:
        noise = 1e-4 * p.output_noise_std
        p = p.replaced({'output_noise_std': noise, 'estimator.output_noise_std': noise})
    try:
        run = build_closed_loop(p).run(case.samples + 1)
    except BROKEN:
        return RandomOutcome(kind, 1e3, 1e3, None)
    off = np.array([abs(float(run.column(n)[-1] / run.column(f'true_{n}')[-1]) - 1.0)
                    for n in ('m', 'c_r', 'c_l')])
    over_bound = float((off / bound_of(p, run.column('v')[:-1])).max())
    return RandomOutcome(kind, min(over_bound, 1e3), float(off.max()), judged(run))


def random_figures(outcomes: Sequence[RandomOutcome]) -> dict[str, Figure]:
    return by_group(outcomes, lambda of: {
        'error / bound, median': figure([r.over_bound for r in of]),
        'beyond 3 % of error': share([r.relative > 0.03 for r in of]),
        **figures_of([r.judged for r in of], ()),
    })


# Backlashes that change, physics that is none of the model, rest.
COASTING: dict[str, list[dict[str, float]]] = {
    'd = 0.5': [{'damping': 0.5}],
    'lightly damped': [{'damping': 0.1}, {'damping': 0.02}, {'damping': 0.1, 'dry': 20.0}],
}
JUMP_S = 4.0


def changes_jobs(scale: float) -> list[Job]:
    """Wear, jumps, a leaking integrator, a walk of u, loads that coast, a wrong sign."""
    jobs = []
    for seed in range(1, 1 + max(round(10 * scale), 1)):
        backlash = random_backlash(seed)
        gap = backlash['backlash.c_r'] - backlash['backlash.c_l']
        gear = {**motor(), **backlash, 'seed': seed}
        jobs += [
            Job('wear', {**PAPER, 'output_noise_std': 1e-3, 'seed': seed,
                         'estimator.drift_std': (0.01, 0.01, 0.01),
                         'backlash.rate': (-0.013, 0.0, 0.0)}, 10.0),
            Job('jump', {**gear, 'backlash.jump_time': JUMP_S,
                         'backlash.jump': (0.0, 0.2 * gap, 0.1 * gap)}, 10.0),
            Job('leak', {'truth.denominator': np.convolve(
                [1.0, -0.999], [1.0, -1.88504, 0.88692]).tolist(), 'output_noise_std': 1e-4,
                'seed': seed}, 10.0),
            Job('walk', {**gear, 'truth.walk_std': 0.02 * backlash['backlash.m'] * gap}, 10.0),
            Job('wrong sign', {**gear, 'truth.numerator': [-b for b in gear['plant.numerator']]},
                10.0),
        ]
        if seed <= max(round(4 * scale), 1):
            jobs += [Job(f'coasting, {name}', gear, 10.0, coasts)
                     for name, kinds in COASTING.items() for coasts in kinds]
    return jobs


def changes_figures(outcomes: Sequence[Outcome]) -> dict[str, Figure]:
    """Figures of each group, and after a jump the time until it is learned again."""
    def of_group(of: Sequence[Outcome]) -> dict[str, Figure]:
        name, runs = of[0].group, [one.judged for one in of]
        found = figures_of(runs, (5.0, 10.0))
        if name == 'wrong sign' or (name.startswith('coasting') and name != 'coasting, d = 0.5'):
            # No gap is right there: what counts is that none is said to be.
            return {what: one for what, one in found.items() if 'wrong' in what}
        if name == 'jump':
            again = [None if run is None else learned_again_s(run) for run in runs]
            found['seconds until within 0.5 % again, median'] = figure(again)
            found['seconds until within 0.5 % again, 90 %'] = figure(again, upper)
        return found

    return by_group(outcomes, of_group)


def learned_again_s(run: Judged) -> float:
    """Time from the jump until *tracking* stays within 0.5 % of the gap to the end, if ever."""
    outside = (run.t > JUMP_S) & ~((run.error <= 0.005) & (run.status == Status.TRACKING))
    return float(run.t[outside][-1]) - JUMP_S if outside.any() else 0.0
