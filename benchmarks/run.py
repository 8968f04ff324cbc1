"""Measure the package: time of a controller step, latency through DDS, speed.

`make bench` runs everything; `make bench ARGS='--only step'` a part of it.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

# Before numpy is imported: the matrices are tiny, threads would only disturb the loop.
os.environ.setdefault('OMP_NUM_THREADS', '1')

from cases.loops import motor
from real_time.costs import COST_HEADER, measure_costs, soak_checks
from real_time.loop_latency import BLOCK, LATENCY_HEADER, lockstep_speed, measure_latencies
from real_time.step_times import LAWS, STEP_HEADER, measure_steps
from reporting import CHECK_HEADER, ROOT, Check, Measured, format_table, machine, markdown_table

from backlash_ros.core import Parameters, build_closed_loop

DOCUMENT = ROOT / 'docs' / 'results' / 'performance.md'
DURATION_S = 20.0
ACQUIRED, SIMULATED_SAMPLES = 3000, 12000


def measure_simulation(_: float) -> Measured:
    noisy = {'output_noise_std': 1e-3}
    loops: dict[str, Mapping[str, object]] = {
        **{f'the example of the paper, {law}': {**noisy, 'estimator.law': law} for law in LAWS},
        'the same, moving_horizon, G exact': {**noisy, 'plant.uncertainty': 0.0},
        'the same, moving_horizon, tracking': {**noisy, 'structure': 'tracking'},
        'geared motor, tracking': {**motor(), 'structure': 'tracking'},
        'geared motor, proportional': {**motor(), 'structure': 'proportional'},
    }
    return [[name, *simulation_speeds(values)] for name, values in loops.items()], []


def simulation_speeds(values: Mapping[str, object]) -> list[str]:
    """Samples per second until the backlash is learned, and after that."""

    def seconds(samples: int) -> float:
        loop = build_closed_loop(Parameters(values))
        start = time.perf_counter()
        loop.run(samples)
        return time.perf_counter() - start

    acquired, whole = seconds(ACQUIRED), seconds(SIMULATED_SAMPLES)
    return [f'{ACQUIRED / acquired:.0f}',
            f'{(SIMULATED_SAMPLES - ACQUIRED) / (whole - acquired):.0f}']


class Part(NamedTuple):
    """A table with what it shows. measure: its rows, and bounds, for a duration [s]."""

    title: str
    explanation: str
    header: tuple[str, ...]
    measure: Callable[[float], Measured]


PARTS = {
    'step': Part(
        'Time of a controller step',
        'One whole controller step beside one predict + update of a KalmanFilter of filterpy with '
        'six states, taking turns in the same loop, once the backlash is known. What the command '
        'need not wait for comes after it.', STEP_HEADER, measure_steps),
    'latency': Part(
        'Latency from y to v',
        'The real controller process beside a bare rclpy node that publishes what it gets, in '
        f'alternating blocks of {BLOCK} samples, as seen by the driver that asks both.',
        LATENCY_HEADER, measure_latencies),
    'costs': Part(
        'What it costs',
        'The default controller and `reference` as processes, beside a bare rclpy node that '
        'publishes every number it gets, at the same rate; once the backlash is known. Times are '
        'those of processors, of all threads; `its fits`: of the process that makes them.',
        COST_HEADER, measure_costs),
    'lockstep': Part(
        'Lockstep', 'Plant, controller and reference as processes over DDS, as fast as they go.',
        ('law', 'samples/s'), lambda duration_s: (
            [[law, f'{lockstep_speed(law):.0f}'] for law in ('moving_horizon', 'lms')], [])),
    'simulate': Part(
        'Simulation',
        'The loop in one process, on one processor. The search for the backlash and the first fits '
        'of a growing record fall into the first samples.',
        ('loop', f'first {ACQUIRED} samples, samples/s', 'the others, samples/s'),
        measure_simulation),
    'soak': Part(
        'At 1 kHz', 'Plant, reference and controller as processes in real time.', CHECK_HEADER,
        lambda duration_s: ([], soak_checks(3.0 * duration_s))),
}


def write_document(tables: Mapping[str, list[list[str]]], checks: list[Check]) -> None:
    paragraphs = [
        '# Performance: what was measured',
        f"Written by `make bench ARGS='--write'` on {machine()}. Ratios carry over to other "
        'machines, the times themselves do not.',
        '## Bounds and verdicts', markdown_table(CHECK_HEADER, [check.row for check in checks]),
    ]
    for name, rows in tables.items():
        if rows:
            part = PARTS[name]
            paragraphs += [f'## {part.title}', part.explanation, markdown_table(part.header, rows)]
    DOCUMENT.write_text('\n\n'.join(paragraphs) + '\n')
    print(f'wrote {DOCUMENT.relative_to(ROOT)}')


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', nargs='+', metavar='PART', default=list(PARTS), choices=PARTS,
                        help=f'parts to measure, of {", ".join(PARTS)}')
    parser.add_argument('--duration', type=float, default=DURATION_S, metavar='SECONDS',
                        help=f'of each measurement of latency, default {DURATION_S:g}')
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all parts')
    arguments = parser.parse_args()
    if not arguments.duration > 0.0:
        parser.error(f'--duration {arguments.duration:g} must be > 0')
    if arguments.write and set(arguments.only) != set(PARTS):
        parser.error('--write needs all parts: leave out --only')
    print(machine())
    tables: dict[str, list[list[str]]] = {}
    checks: list[Check] = []
    for name in arguments.only:
        part = PARTS[name]
        tables[name], further = part.measure(arguments.duration)
        checks += further
        # Shown as soon as it is known: all of them take minutes.
        rows = tables[name] or [check.row for check in further]
        print(f'\n{part.title}\n{format_table(part.header, rows)}', flush=True)
    if checks:
        print('\n' + format_table(CHECK_HEADER, [check.row for check in checks]))
    if arguments.write:
        write_document(tables, checks)
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
