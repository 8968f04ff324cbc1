"""How closely y follows y_m, against the same loop without backlash and without compensation.

    python benchmarks/tracking.py [--point N] [--cases N] [--first-seed N]

Each line of the table is a bound and what was measured. Errors are against y_m delayed by the
preview window. Point 2 is about the measured y, as it stands in samples.csv; what is left of it
before the sensor adds its noise is printed as well, and all other points are about that.

Three loops are compared, equal but for what their names say:
adaptive: nothing known of the backlash at the start.
without backlash: gap 0, slope known.
uncompensated: slope known, gap taken as 0, with an observer that allows for what that gets wrong.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from math import inf, nan, pi
from pathlib import Path

# The matrices are tiny: threads of the linear algebra would only disturb the other processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402
from cases.random_cases import random_case  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy import signal  # noqa: E402

from backlash_ros.core.assembly import build_model  # noqa: E402
from backlash_ros.core.parameters import Parameters  # noqa: E402
from backlash_ros.core.reference.signal import ReferenceSignal  # noqa: E402
from backlash_ros.core.simulation.closed_loop import build_closed_loop  # noqa: E402
from backlash_ros.core.simulation.metrics import (  # noqa: E402
    delayed_reference,
    delayed_tracking_error_rms,
    gap_crossings_per_reversal,
    total_variation,
    turns,
)
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord  # noqa: E402
from backlash_ros.tools.cli import format_table  # noqa: E402

Array = NDArray[np.float64]

SETTLED_S = 2.0  # from here on the loop counts as settled
SEEDS = range(1, 21)  # of point 3, and of the reference that begins slowly
SLOW_START = 'chirp 0.1 to 3 Hz'
UNSTABLE = 3.0  # y beyond this many times the reference after three periods
NO_GAP = {'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9}


@dataclass(frozen=True)
class Job:
    """One run; reference: its y_m where it is none of the waveforms."""

    parameters: Parameters
    samples: int
    reference: tuple[float, ...] = ()


@dataclass(frozen=True)
class Result:
    """A run and its y before the sensor; problem: why it broke off, if it did."""

    run: RunRecord
    y: Array
    delay: int  # samples by which y is to follow
    problem: str = ''

    def error(self, since: float, measured: bool = False) -> float:
        """Relative RMS tracking error from `since` on; inf for a run that broke off."""
        if self.problem:
            return inf
        y = None if measured else self.y
        value = delayed_tracking_error_rms(self.run, self.delay, since, y)
        return nan if value is None else value

    def deviation(self) -> Array:
        """y - y_m(k - delay)."""
        return self.y - delayed_reference(self.run, self.delay)

    def tail(self, name: str, since: float) -> Array:
        """A signal from `since` on."""
        return self.run.column(name)[self.run.column('t') >= since]


@dataclass(frozen=True)
class Check:
    """One line of the table."""

    point: int
    what: str
    bound: float
    measured: float
    least: bool = False  # the bound is the least value allowed, not the largest

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; nan never is."""
        return self.measured >= self.bound if self.least else self.measured <= self.bound


Simulate = Callable[[Iterable[Job]], list[Result]]


def run_job(job: Job) -> Result:
    """Simulate one run; a run that breaks off is a result as well."""
    p = job.parameters
    loop = build_closed_loop(p)
    if job.reference:
        period = p.get_float('sample_period')
        loop.reference = ReferenceSignal('file', sample_period=period, samples=job.reference)
    delay = loop.controller.structure.delay
    try:
        with np.errstate(over='ignore', invalid='ignore'):
            run = loop.run(job.samples)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return Result(RunRecord(np.zeros((1, len(COLUMNS))), 1.0), np.zeros(1), delay, str(error))
    u = run.column('u') + p.get_float('input_disturbance')
    model = build_model(p)
    return Result(run, signal.lfilter(model.numerator, model.denominator, u), delay)


def scenario(**changes: object) -> dict[str, object]:
    """The paper's plant with the tracking structure and y_m = 0.2 sin 12.6 t."""
    named = {name.replace('__', '.'): value for name, value in changes.items()}
    return {'structure': 'tracking', 'amplitude': 0.2, **named}


def adaptive(values: dict[str, object]) -> Parameters:
    """The loop that learns."""
    return Parameters(values)


def without_backlash(values: dict[str, object]) -> Parameters:
    """The same loop with the backlash removed."""
    slope = Parameters(values).get_float('backlash.m')
    return Parameters({**values, **NO_GAP, **_known(slope, 0.0, 0.0), 'fixed.doubt': 0.0,
                       'backlash.initial_u': 0.0})


def uncompensated(values: dict[str, object]) -> Parameters:
    """The same loop without compensation."""
    slope = Parameters(values).get_float('backlash.m')
    return Parameters({**values, **_known(slope, 0.0, 0.0), 'fixed.doubt': 0.5})


def exact(values: dict[str, object]) -> Parameters:
    """The same loop with the true backlash known and no noise."""
    p = Parameters(values)
    m, c_r, c_l = (
        p.get_float('backlash.m'),
        p.get_float('backlash.c_r'),
        p.get_float('backlash.c_l'),
    )
    return Parameters({**values, **_known(m, c_r, c_l), 'output_noise_std': 0.0})


def _known(m: float, c_r: float, c_l: float) -> dict[str, object]:
    return {'estimator.law': 'fixed', 'estimator.initial.m': m, 'estimator.initial.c_r': c_r,
            'estimator.initial.c_l': c_l}


def three(values: dict[str, object], samples: int, reference: Sequence[float] = ()) -> list[Job]:
    """Adaptive, without backlash and uncompensated."""
    return [
        Job(make(values), samples, tuple(reference))
        for make in (adaptive, without_backlash, uncompensated)
    ]


def point_1(simulate: Simulate) -> Iterator[Check]:
    """Sine without noise."""
    amplitudes = (0.2, 1.0, 10.0)
    results = simulate(job for a in amplitudes for job in three(scenario(amplitude=a), 800))
    for i, a in enumerate(amplitudes):
        learns, ideal, plain = (r.error(SETTLED_S) for r in results[3 * i:3 * i + 3])
        yield Check(1, f'sine {a:g}: adaptive / without backlash', 1.02, learns / ideal)
        if a == 0.2:
            yield Check(1, f'sine {a:g}: uncompensated / without backlash', 10.0, plain / ideal,
                        least=True)


def references(noise: float) -> dict[str, tuple[dict[str, object], int, list[float]]]:
    """The references of point 2 by name: parameters, samples and the file."""
    t = np.arange(900) * 0.01
    rest = np.where(t < 4.0, 0.2 * np.sin(12.6 * t), 0.2 * np.sin(12.6 * 4.0))
    n = {'output_noise_std': noise}
    return {
        'sine': (scenario(**n), 800, []),
        'steps': (scenario(waveform='square', frequency=pi, **n), 1000, []),
        'triangle': (scenario(waveform='triangle', frequency=2.0 * pi, **n), 1000, []),
        SLOW_START: (
            scenario(waveform='chirp', frequency_start=0.2 * pi, frequency=6.0 * pi, **n),
            1200, [],
        ),
        'sine, then rest': (scenario(**n), 900, rest.tolist()),
    }


def point_2(simulate: Simulate) -> Iterator[Check]:
    """Other references with noise, and rest."""
    named = references(1e-3)
    results = simulate(job for values in named.values() for job in three(*values))
    for i, name in enumerate(named):
        group = results[3 * i:3 * i + 3]
        learns, ideal, _ = (r.error(SETTLED_S, measured=True) for r in group)
        yield Check(2, f'{name}: adaptive / without backlash', 1.1, learns / ideal)
        learns, ideal, plain = (r.error(SETTLED_S) for r in group)
        print(f'  ({name}, before the sensor: without backlash {ideal:.3g}, adaptive '
              f'{learns / ideal:.3g} times, uncompensated {plain / ideal:.3g} times)')
    chirp, samples, _ = named[SLOW_START]
    noises = [{**chirp, 'seed': seed} for seed in SEEDS]
    results = simulate(
        Job(make(values), samples) for values in noises for make in (adaptive, without_backlash)
    )
    ratios = [
        learns.error(SETTLED_S, measured=True) / ideal.error(SETTLED_S, measured=True)
        for learns, ideal in zip(results[::2], results[1::2], strict=True)
    ]
    yield Check(2, f'{SLOW_START}, worst of {len(SEEDS)} noises: adaptive / without backlash', 1.1,
                max(ratios))
    rests = [
        (f'{name}, noise {noise:g}', Job(adaptive(values), samples, tuple(reference)))
        for noise in (0.0, 1e-3)
        for name, (values, samples, reference) in {
            'rest from the start': (scenario(amplitude=0.0, output_noise_std=noise), 900, ()),
            'rest after a sine': references(noise)['sine, then rest'],
        }.items()
    ]
    for (name, _), result in zip(rests, simulate(job for _, job in rests), strict=True):
        v = result.tail('v', 6.0)
        yield Check(2, f'{name}: share of samples in which v moves', 0.05,
                    float(np.mean(np.diff(v) != 0.0)))
        yield Check(2, f'{name}: turns of v across the gap in 3 s', 1.0, float(turns(v, 3.0)))


def point_3(simulate: Simulate) -> Iterator[Check]:
    """Chatter of v."""
    amplitudes = (0.2, 1.0, 10.0)
    jobs: list[Job] = []
    for a in amplitudes:
        values = scenario(amplitude=a, output_noise_std=1e-3)
        jobs += [Job(exact(values), 1000)]
        jobs += [Job(adaptive({**values, 'seed': seed}), 1000) for seed in SEEDS]
    results = simulate(jobs)
    for i, a in enumerate(amplitudes):
        size = 1 + len(SEEDS)
        best, *noisy = results[size * i:size * (i + 1)]
        crossings = [gap_crossings_per_reversal(r.run, SETTLED_S) or 0.0 for r in noisy]
        way = [total_variation(r.tail('v', SETTLED_S)) for r in noisy]
        least = total_variation(best.tail('v', SETTLED_S))
        yield Check(3, f'sine {a:g}: gap crossings per reversal, worst seed', 1.1,
                    max(crossings))
        above = [seed for seed, count in zip(SEEDS, crossings, strict=True) if count > 1.1]
        print(f'  (sine {a:g}: mean {np.mean(crossings):.3f}, seeds above 1.1: {above})')
        yield Check(3, f'sine {a:g}: total variation of v / exact inverse', 1.3,
                    max(way) / least)


def limited(values: dict[str, object], share: float, peak: float, rate: float,
            gapless: bool) -> dict[str, object]:
    """Limits of v that give u the same reach with and without the gap."""
    room = share * peak
    # The gap takes c_r of the reach of v; the loop without one is given what is left.
    reach = room - 3.0 if gapless else room
    return {**values, 'control.max': reach, 'control.min': -reach, 'control.rate_max': rate}


def point_4(simulate: Simulate) -> Iterator[Check]:
    """Saturation and rate limit."""
    t = np.arange(1200) * 0.01
    burst = np.where(t < 6.0, 0.3, 0.1) * np.sin(12.6 * t)
    cases: dict[str, tuple[dict[str, object], int, list[float]]] = {
        'steps': (scenario(waveform='square', frequency=pi), 1200, []),
        'burst': (scenario(), 1200, burst.tolist()),
        'steps with noise': (
            scenario(waveform='square', frequency=pi, output_noise_std=1e-3), 1200, []),
    }
    free = simulate(Job(exact(v), n, tuple(r)) for v, n, r in cases.values())
    ideal = simulate(Job(without_backlash(v), n, tuple(r)) for v, n, r in cases.values())
    jobs: list[Job] = []
    for (values, samples, reference), f, g in zip(cases.values(), free, ideal, strict=True):
        peak = float(np.abs(f.tail('v', SETTLED_S)).max())
        rate = 0.6 * float(np.abs(np.diff(g.tail('v', SETTLED_S))).max()) / 0.01
        for make, gapless in ((adaptive, False), (without_backlash, True)):
            p = make(limited(values, 0.6, peak, rate, gapless))
            jobs.append(Job(p, samples, tuple(reference)))
    results = simulate(jobs)
    for i, name in enumerate(cases):
        learns, gapless = results[2 * i:2 * i + 2]
        excess = [_overshoot(r) for r in (learns, gapless)]
        yield Check(4, f'{name}: overshoot / without backlash', 1.1, excess[0] / excess[1])
        # A ratio of two loops that both cycle would say nothing.
        yield Check(4, f'{name}: largest |y| without backlash / largest |y_m|', 1.5, excess[1])
        yield from _within_two_percent(name, learns)


def _overshoot(result: Result) -> float:
    """Largest |y| beyond the largest |y_m| after 6.5 s, relative to the swing of y_m there."""
    since = 6.5 + 0.01 * result.delay
    rows = result.run.column('t') >= since
    reference = np.abs(delayed_reference(result.run, result.delay)[rows]).max()
    return float(np.abs(result.y[rows]).max()) / float(reference)


def _within_two_percent(name: str, result: Result) -> Iterator[Check]:
    last = result.run
    worst = max(
        abs(float(last.column(k)[-1]) / float(last.column(f'true_{k}')[-1]) - 1.0)
        for k in ('m', 'c_r', 'c_l')
    )
    yield Check(4, f'{name}: worst estimate, relative error', 0.02, worst)


def tracked_case(seed: int) -> tuple[dict[str, object], int]:
    """A case of the estimation benchmark whose reference is one for y, and its period."""
    case = random_case(seed)
    p = case.parameters
    z = np.exp(1j * p.get_float('frequency') * p.get_float('sample_period'))
    gain = abs(complex(build_model(p).response(np.array([z]))[0]))
    values = {**p, 'structure': 'tracking', 'amplitude': gain * p.get_float('amplitude')}
    return values, case.samples // 3


def point_5(simulate: Simulate, cases: int = 100, first: int = 0) -> Iterator[Check]:
    """Random plants, gaps and noise."""
    seeds = range(first, first + cases)
    chosen = [tracked_case(seed) for seed in seeds]
    jobs = []
    for values, period in chosen:
        delay = Parameters(values).get_int('tracking.preview')
        jobs += three(values, delay + 8 * period)
    results = simulate(jobs)
    unstable, cancelled = [], 0
    for i, (seed, (_, period)) in enumerate(zip(seeds, chosen, strict=True)):
        learns, ideal, plain = results[3 * i:3 * i + 3]
        since = 0.01 * (learns.delay + 3 * period)
        a, b, c = (r.error(since) for r in (learns, ideal, plain))
        kind = random_case(seed).kind
        if learns.problem or not _bounded(learns, since):
            unstable.append(seed)
            print(f'  seed {seed} ({kind}): unstable {learns.problem}')
        # Where the backlash costs the uncompensated loop nothing there is nothing to cancel.
        if a - b <= max(0.1 * (c - b), 0.02 * b):
            cancelled += 1
        else:
            print(f'  seed {seed} ({kind}): {a:.3g} adaptive, {b:.3g} without backlash, '
                  f'{c:.3g} uncompensated')
    yield Check(5, f'{cases} random cases: unstable', 0.0, float(len(unstable)))
    yield Check(5, f'{cases} random cases: share with a tenth of the penalty or less', 0.98,
                cancelled / cases, least=True)


def _bounded(result: Result, since: float) -> bool:
    rows = result.run.column('t') >= since
    reference = np.abs(delayed_reference(result.run, result.delay)[rows]).max()
    return bool(np.abs(result.y[rows]).max() <= UNSTABLE * reference)


def point_7(simulate: Simulate) -> Iterator[Check]:
    """Start-up with nothing known."""
    chosen = {
        f'{waveform} {a:g}, noise {noise:g}': scenario(
            amplitude=a, output_noise_std=noise, waveform=waveform,
            frequency=12.6 if waveform == 'sine' else pi,
        )
        for waveform in ('sine', 'square') for a in (0.2, 1.0, 10.0) for noise in (0.0, 1e-3)
    }
    results = simulate(job for values in chosen.values() for job in three(values, 300))
    for i, name in enumerate(chosen):
        learns, _, plain = results[3 * i:3 * i + 3]
        peaks = [float(np.abs(r.y).max()) for r in (learns, plain)]
        away = [float(np.abs(r.deviation()).max()) for r in (learns, plain)]
        yield Check(7, f'{name}: largest |y| / uncompensated', 1.2, peaks[0] / peaks[1])
        print(f'  ({name}: largest |y - y_m| adaptive {away[0]:.3g}, uncompensated {away[1]:.3g},'
              f' ratio {away[0] / away[1]:.3g})')


POINTS: dict[int, Callable[[Simulate], Iterator[Check]]] = {
    1: point_1, 2: point_2, 3: point_3, 4: point_4, 5: point_5, 7: point_7,
}


def main(args: Sequence[str] | None = None) -> int:
    """Print the table; return how many bounds are broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--point', type=int, choices=sorted(POINTS), action='append')
    parser.add_argument('--cases', type=int, default=100, help='random cases of point 5')
    parser.add_argument('--first-seed', type=int, default=0, help='of these cases')
    options = parser.parse_args(args)
    checks: list[Check] = []
    with ProcessPoolExecutor() as pool:
        def simulate(jobs: Iterable[Job]) -> list[Result]:
            return list(pool.map(run_job, list(jobs), chunksize=1))
        for number in options.point or sorted(POINTS):
            if number == 5:
                checks += point_5(simulate, options.cases, options.first_seed)
            else:
                checks += POINTS[number](simulate)
    print(format_table(('point', 'what', 'bound', 'measured', ''), [
        (str(c.point), c.what, f'{">=" if c.least else "<="} {c.bound:g}', f'{c.measured:.4g}',
         'holds' if c.holds else 'BROKEN') for c in checks
    ]))
    return sum(not c.holds for c in checks)


if __name__ == '__main__':
    sys.exit(main())
