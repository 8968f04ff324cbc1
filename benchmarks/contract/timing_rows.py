"""Rows of time, measured alone: steps, refits, 1 kHz over DDS, simulated samples.

Times are in units of one predict + update of filterpy's KalmanFilter with six states, measured in
the same loop, or of a bare echo node: so they carry over to other machines.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cases.loops import motor
from contract.figures import Array, Figure, figure
from real_time.loop_latency import measure_latency
from real_time.step_times import Sampled, filter_timer
from scipy.optimize import least_squares
from scipy.signal import lfilter

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.plant.backlash import play

LEAST_SCATTER = 0.05  # relative, of a time: what one run of a machine does not show
QUANTILES = {'p50': 0.5, 'p99': 0.99}
ACQUISITION, STEADY = 200, 1500  # samples
LATENCY_S, RATE_HZ = 5.0, 1000.0
SIMULATED = 8000


Times = dict[str, float]  # ratios of one repetition, by figure


def repeated(scale: float, names: Sequence[str], times: int) -> list[tuple[str, int]]:
    """Every name so often, in turns: a slow moment of the machine hits all."""
    return [(name, i) for i in range(max(round(times * scale), 2)) for name in names]


def times_figures(found: Sequence[Times]) -> dict[str, Figure]:
    names = dict.fromkeys(name for one in found for name in one)
    return {name: figure([one.get(name) for one in found], least_scatter=LEAST_SCATTER)
            for name in names}


def step_jobs(scale: float) -> list[tuple[str, int]]:
    return repeated(scale, ('proportional', 'tracking'), 6)


def run_step(job: tuple[str, int]) -> Times:
    """Step and what follows on it, while the backlash is searched and afterwards."""
    structure, seed = job
    sampled = Sampled(Parameters({'structure': structure, 'output_noise_std': 1e-3,
                                  'seed': seed + 1}))
    timer = filter_timer()
    steps, refits, filters = np.array([
        (sampled.step(), sampled.refined, timer()) for _ in range(ACQUISITION + STEADY)]).T
    unit = float(np.median(filters))
    found = {}
    for what, times in (('step', steps), ('refit', refits)):
        for phase, part in (('searching', slice(0, ACQUISITION)),
                            ('steady', slice(ACQUISITION, None))):
            of, name = times[part] / unit, f'{what}, {structure}, {phase}'
            found |= {f'{name}, {word}': float(np.quantile(of, q)) for word, q in QUANTILES.items()}
            found[f'{name}, mean'] = float(of.mean())
    return found


def latency_jobs(scale: float) -> list[tuple[str, int]]:
    return repeated(scale, ('proportional', 'tracking', 'lms'), 4)


def run_latency(job: tuple[str, int]) -> Times:
    """From y to v beside the echo, a controller process of its own each time."""
    name, _ = job
    law = name if name == 'lms' else 'moving_horizon'
    structure = 'proportional' if name == 'lms' else name
    found = measure_latency(RATE_HZ, law, LATENCY_S, {'structure': structure})
    return {f'{law}, {structure}, {quantile} / echo': found.ratio(q)
            for quantile, q in QUANTILES.items()}


SIMULATIONS: dict[str, Callable[[], dict[str, Any]]] = {
    'example of the paper': lambda: {'output_noise_std': 1e-3},
    'example of the paper, tracking':
        lambda: {'output_noise_std': 1e-3, 'structure': 'tracking'},
    'example of the paper, lms': lambda: {'output_noise_std': 1e-3, 'estimator.law': 'lms'},
    'geared motor': motor,
    'geared motor, slow moves': lambda: {**motor(), 'waveform': 'triangle', 'frequency': 2.0},
}


def simulate_jobs(scale: float) -> list[tuple[str, int]]:
    return repeated(scale, tuple(SIMULATIONS), 4)


def run_simulate(job: tuple[str, int]) -> Times:
    """Processor time of a sample in one process."""
    name, seed = job
    loop = build_closed_loop(Parameters({**SIMULATIONS[name](), 'seed': seed + 1}))
    timer = filter_timer()
    unit = float(np.median([timer() for _ in range(2000)]))
    begun = time.process_time()
    loop.run(SIMULATED)
    return {f'{name}: processor time of a sample':
            (time.process_time() - begun) / SIMULATED / unit}


IDENTIFIED = {'4,000 samples': (4000, 0.005), '60 s at 1 kHz': (60_000, 0.001),
              'a week at one minute': (10_080, 60.0)}
GAP, B, A = 0.3, [0.0, 0.05, 0.045], [1.0, -1.6, 0.695]


def identify_jobs(scale: float) -> list[tuple[str, int]]:
    return repeated(scale, tuple(IDENTIFIED), 3)  # fewer show no scatter


def run_identify(job: tuple[str, int]) -> Times:
    """`identify`, start and page included, beside a plain least squares given the true gap."""
    name, seed = job
    count, period = IDENTIFIED[name]
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    v = np.sin(0.011 * k) + 0.6 * np.sin(0.026 * k + 1.0) + 0.3 * np.sin(0.053 * k + 2.0)
    p = play(v, GAP, float(v[0]))
    y = lfilter(B, A, p - 0.5 * GAP) + 1e-3 * rng.standard_normal(count)

    def left(x: Array) -> Array:
        out = lfilter([0.0, *x[:2]], [1.0, *x[2:4]], p - x[4], zi=x[5:])[0]
        return np.asarray(out - y)

    begun = time.process_time()
    least_squares(left, [0.1, 0.0, -1.5, 0.6, 0.0, 0.0, 0.0], x_scale='jac')
    floor = time.process_time() - begun
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'record.csv'
        np.savetxt(path, np.column_stack([period * k, v, y]), '%.9g', ',', header='t,v,y',
                   comments='')
        begun = sum(os.times()[2:4])
        subprocess.run([sys.executable, '-m', 'backlash_ros.tools.identify', str(path), '--out',
                        folder], check=True, capture_output=True)
        spent = sum(os.times()[2:4]) - begun
    return {f'identify, {name} [s]': spent, f'identify, {name} / given the gap': spent / floor}
