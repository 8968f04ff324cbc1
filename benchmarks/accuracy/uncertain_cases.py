"""Plants that differ from the G(z) that is told, random backlashes and references."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from typing import TypeVar

import numpy as np

from backlash_ros.core.assembly import build_reference, build_true_model
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config.configuration import effective_parameters

Case = TypeVar('Case')

MOTOR = Path('geared_motor.yaml')
EXACT = 'exact'
TOLD_DAMPING = 0.5  # of geared_motor.yaml
# What a true plant differs in: name and parameters of each value, by kind.
KINDS: dict[str, dict[str, dict[str, object]]] = {
    'frequency': {
        f'ω × {f:g}': {'truth.scale_frequency': f} for f in (0.8, 0.9, 0.98, 1.02, 1.1, 1.2)
    },
    'damping': {
        f'd = {d:g}': {'truth.scale_damping': d / TOLD_DAMPING} for d in (0.4, 0.6)
    },
    'lag': {f'lag {1e3 * s:g} ms': {'truth.extra_lag': s} for s in (0.001, 0.005)},
    'delay': {'delay 1': {'truth.delay_samples': 1}},
}
FAR: dict[str, dict[str, object]] = {
    'ω × 0.5': {'truth.scale_frequency': 0.5}, 'ω × 1.5': {'truth.scale_frequency': 1.5},
    'lag 20 ms': {'truth.extra_lag': 0.02},
}
SLOPES, GAPS = (0.06, 0.15), (0.2, 2.0)  # [u/v], [v]
SHARE = (0.2, 0.8)  # of the gap that is c_r
FREEZES_AT_S = 3.7  # on its way, where the reference stops in `freeze`
# What is different of the motion, by name.
MOTIONS: dict[str, dict[str, object]] = {
    'triangle': {'waveform': 'triangle'}, 'square': {'waveform': 'square'},
    'chirp': {'waveform': 'chirp', 'frequency_start': 0.63, 'frequency': 18.8},
    'limits': {'control.min': -6.0, 'control.max': 6.0, 'control.rate_max': 60.0},
    'loss': {'output_loss': 0.2},
}
FREEZE = 'freeze'
MOTION_CASES = (EXACT, 'ω × 1.2', 'lag 5 ms')  # plants with which these are tried


@dataclass(frozen=True)
class Job:
    """One run. name: of the case. reference: its y_m where it is none of the waveforms.

    coasts: damping and dry friction of a CoastingLoad in the place of the simulated plant.
    """

    name: str
    seed: int
    parameters: Parameters
    samples: int
    reference: tuple[float, ...] = ()
    coasts: Mapping[str, float] = field(default_factory=dict)


def near_cases() -> dict[str, dict[str, object]]:
    """Every single difference, and every pair of different kinds, by name."""
    cases = {name: dict(change) for kind in KINDS.values() for name, change in kind.items()}
    for first, second in combinations(KINDS.values(), 2):
        for (a, change_a), (b, change_b) in product(first.items(), second.items()):
            cases[f'{a}, {b}'] = {**change_a, **change_b}
    return cases


def chosen(cases: Mapping[str, Case], words: Sequence[str]) -> dict[str, Case]:
    """The cases whose name holds one of the words; all where there are none."""
    return {
        name: change for name, change in cases.items()
        if not words or any(word in name for word in words)
    }


def random_backlash(seed: int) -> dict[str, object]:
    """Slope, and a gap that is split at random between c_r and -c_l."""
    rng = np.random.default_rng([seed, 12])
    gap, share = rng.uniform(*GAPS), rng.uniform(*SHARE)
    return {
        'backlash.m': float(rng.uniform(*SLOPES)), 'backlash.c_r': float(gap * share),
        'backlash.c_l': float(gap * (share - 1.0)), 'seed': seed,
    }


def motor_jobs(
    cases: Mapping[str, Mapping[str, object]], seeds: Sequence[int], seconds: float,
    **changes: object,
) -> Iterator[Job]:
    """The geared motor with the true plant of every case and the backlash of every seed."""
    base = effective_parameters(MOTOR)
    samples = round(seconds / base.get_float('sample_period')) + 1
    changed = {name.replace('__', '.'): value for name, value in changes.items()}
    for (name, case), seed in product(cases.items(), seeds):
        p = base.replaced({**changed, **case, **random_backlash(seed)})
        yield Job(name, seed, p, samples)


def frozen_reference(p: Parameters, samples: int) -> tuple[float, ...]:
    """The reference of the parameters until it freezes."""
    reference, period = build_reference(p), p.get_float('sample_period')
    return tuple(reference(min(k * period, FREEZES_AT_S)) for k in range(samples))


def ideal(job: Job) -> Job:
    """The same loop, given the true backlash and the true G."""
    p = job.parameters
    true = build_true_model(p)
    known = {f'estimator.initial.{name}': p[f'backlash.{name}'] for name in ('m', 'c_r', 'c_l')}
    return Job(job.name, job.seed, p.replaced({
        **known, 'estimator.law': 'fixed', 'fixed.doubt': 0.0, 'plant.uncertainty': 0.0,
        'plant.numerator': true.numerator.tolist(), 'plant.denominator': true.denominator.tolist(),
        'control.delay_samples': 0, 'truth.numerator': [], 'truth.denominator': [],
        'truth.delay_samples': -1, 'truth.scale_frequency': 1.0, 'truth.scale_damping': 1.0,
        'truth.extra_lag': 0.0,
    }), job.samples, job.reference)
