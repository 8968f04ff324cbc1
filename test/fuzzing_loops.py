"""Whole loops with a plant that changes and a sensor that fails, through every phase of learning.

    python test/fuzzing_loops.py --loops 1000

Unlike the sequences of fuzzing.py these are long enough for an estimate to be found, trusted,
contradicted, challenged and replaced.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import warnings
from math import inf, isfinite

# The matrices are tiny: threads of the linear algebra would only disturb the other processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.parameters import Parameters

SAMPLES = 2000  # of a loop
LOW, HIGH = -60.0, 50.0
PLANTS: tuple[dict[str, object], ...] = (
    {},  # the example
    {'plant.numerator': [0.05], 'plant.denominator': [1.0, -0.95]},
    {'plant.numerator': [0.02], 'plant.denominator': [1.0, -1.0]},
    {'plant.numerator': [0.01, 0.009], 'plant.denominator': [1.0, -1.8, 0.82]},
    {'plant.numerator': [0.003, 0.002], 'plant.denominator': [1.0, -1.95, 0.95]},
)
FAULTS = ('lost', 'bursts', 'frozen', 'flipped', 'spikes', 'huge')


def parameters_of(rng: np.random.Generator) -> Parameters:
    """A random loop."""
    noise = float(rng.choice([0.0, 1e-4, 1e-2]))
    return Parameters({
        **PLANTS[int(rng.integers(len(PLANTS)))],
        'estimator.law': str(rng.choice(['moving_horizon'] * 3 + ['lms', 'fixed'])),
        'structure': str(rng.choice(['proportional', 'tracking'])),
        'waveform': str(rng.choice(['sine', 'square', 'triangle'])),
        'amplitude': float(rng.choice([0.2, 1.0, 10.0])),
        'frequency': float(rng.uniform(2.0, 20.0)),
        'backlash.m': float(rng.uniform(0.3, 3.0)),
        'backlash.c_r': float(rng.uniform(0.1, 6.0)),
        'backlash.c_l': -float(rng.uniform(0.1, 6.0)),
        'output_noise_std': noise,
        'estimator.output_noise_std': noise * float(rng.choice([0.3, 1.0, 3.0])),
        'control.min': LOW, 'control.max': HIGH,
        'control.rate_max': float(rng.choice([inf, 300.0])),
        'control.delay_samples': int(rng.integers(0, 2)), 'seed': int(rng.integers(1000)),
    })


class LoopFuzzer:
    """A loop whose plant changes and whose sensor fails now and then."""

    def __init__(self, seed: int) -> None:
        self._rng = rng = np.random.default_rng([seed, 7])
        self.parameters = p = parameters_of(rng)
        self._plant, self._reference = build_plant(p), build_reference(p)
        self._core = build_controller(p)
        self._reports = bool(rng.integers(2))  # whether the driver says which v acted
        self._fault, self._until, self._stuck = '', 300, 0.0
        self._v = 0.0
        self.commands = 0  # that were checked

    def run(self, samples: int) -> None:
        """Raises AssertionError for what must not be."""
        period = self.parameters.get_float('sample_period')
        lost: list[float] = []  # v of the samples whose y did not come
        for k in range(samples):
            if k == self._until:
                self._change(k)
            y = self._seen(self._plant.measure(), k)
            if k == 0 or plausible(y):
                applied = (*lost, self._v) if self._reports and k else ()
                step = self._core.step(y, self._reference(k * period), len(lost), applied)
                self._core.refine()
                self._check(step.v, step.estimate)
                self._v, lost = step.v, []
            else:
                lost.append(self._v)
            self._plant.step(self._v)

    def _check(self, v: float, estimate: Estimate) -> None:
        self.commands += 1
        assert isfinite(v), v
        assert LOW <= v <= HIGH, v
        p = self.parameters
        move = p.get_float('control.rate_max') * p.get_float('sample_period')
        assert abs(v - self._v) <= move * (1.0 + 1e-9), (v, self._v)
        assert isfinite(estimate.m), estimate
        assert estimate.m > 0.0, estimate
        assert -inf < estimate.c_l <= 0.0 <= estimate.c_r < inf, estimate

    def _seen(self, y: float, k: int) -> float:
        """What arrives of y; nan where nothing does."""
        chance = float(self._rng.random())
        if self._fault == 'lost' and chance < 0.3:
            return np.nan
        if self._fault == 'bursts' and k // 50 % 2:
            return np.nan
        if self._fault == 'frozen':
            return self._stuck
        if self._fault == 'flipped':
            return -y
        if self._fault == 'spikes' and chance < 0.05:
            return y + 100.0 * float(self._rng.standard_normal())
        if self._fault == 'huge' and chance < 0.02:
            return 1e11 * (chance - 0.01)
        self._stuck = y
        return y

    def _change(self, k: int) -> None:
        """Let a fault begin, or the present one end, and now and then something else happen."""
        rng = self._rng
        self._fault = str(rng.choice(FAULTS)) if not self._fault else ''
        self._until = k + int(rng.integers(20, 500))
        kind = int(rng.integers(8))
        if kind == 0:
            backlash = self._plant.backlash
            backlash.m *= float(rng.uniform(0.7, 1.5))
            backlash.c_r += float(rng.uniform(0.0, 2.0))
        elif kind == 1:
            self._core.estimator.adapting = not self._core.estimator.adapting
        elif kind == 2:
            self._core.compensating = not self._core.compensating
        elif kind == 3:
            self._core = build_controller(self.parameters, self._core.estimator.estimate)
            self._core.start_from(self._v)


def fuzz_loop(seed: int) -> int:
    """Run the loop of a seed; returns the number of commands that were checked."""
    fuzzer = LoopFuzzer(seed)
    try:
        fuzzer.run(SAMPLES)
    except Exception:
        print(f'seed {seed}: {fuzzer.parameters}', file=sys.stderr)
        raise
    return fuzzer.commands


def main() -> int:
    """Fuzz in as many processes as there are processors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--loops', type=int, default=1000)
    parser.add_argument('--first-seed', type=int, default=1)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.loops)
    with multiprocessing.Pool(initializer=warnings.simplefilter, initargs=('error',)) as pool:
        for done, _ in enumerate(pool.imap_unordered(fuzz_loop, seeds), 1):
            print(f'\r{done} loops of {SAMPLES} samples', end='', flush=True)
    print(': no exception, no warning, every command finite and within the limits')
    return 0


if __name__ == '__main__':
    sys.exit(main())
