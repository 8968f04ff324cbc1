"""Measure the package: time of a controller step, latency through DDS, speed.

`make bench` runs everything; `make bench ARGS='--only step'` a part of it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

# Before numpy is imported: the matrices are tiny, threads would only disturb the loop.
os.environ.setdefault('OMP_NUM_THREADS', '1')

from cases.geared_motor import motor
from real_time.costs import COST_HEADER, COST_RATES_HZ, measure_costs
from real_time.loop_latency import (
    BLOCK,
    LATENCY_HEADER,
    RATES_HZ,
    latency_checks,
    lockstep_speed,
    measure_latency,
)
from real_time.soak import soak_checks
from real_time.step_times import LAWS, STEP_HEADER, law_times, step_checks, step_rows
from reporting import CHECK_HEADER, ROOT, Check, machine, markdown_table, text_table

from backlash_ros.core import Parameters, build_closed_loop

DOCUMENT = ROOT / 'docs' / 'results' / 'performance.md'
DURATION_S = 20.0
LATENCY_LOOPS = (('moving_horizon', 'proportional'), ('moving_horizon', 'tracking'),
                 ('lms', 'proportional'))
ACQUIRED, SIMULATED_SAMPLES = 3000, 12000


@dataclass
class Section:
    """A table with what it shows, and the bounds it is held to."""

    title: str
    explanation: str
    header: tuple[str, ...]
    rows: list[list[str]] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)


def measure_steps(_: float) -> Section:
    """Time of one controller step."""
    times = law_times()
    return Section(
        'Time of a controller step',
        'One whole controller step beside one predict + update of a KalmanFilter of filterpy with '
        'six states, taking turns in the same loop, once the backlash is known. What the command '
        'need not wait for comes after it.',
        STEP_HEADER, step_rows(times), step_checks(times),
    )


def measure_latencies(duration_s: float) -> Section:
    """Latency of the controller process."""
    section = Section(
        'Latency from y to v',
        'The real controller process beside a bare rclpy node that publishes what it gets, in '
        f'alternating blocks of {BLOCK} samples, as seen by the driver that asks both.',
        ('loop', *LATENCY_HEADER),
    )
    for law, structure in LATENCY_LOOPS:
        for rate in RATES_HZ:
            name = f'{law}, {structure}'
            found = measure_latency(rate, law, duration_s, {'structure': structure})
            section.rows += [[name, *row] for row in found.rows]
            section.checks += latency_checks(found, name)
            if found.unanswered:
                print(f'{name}, {rate:g} Hz: {found.unanswered} samples without an answer')
    return section


def measure_lockstep(_: float) -> Section:
    """Speed of lockstep."""
    return Section(
        'Lockstep', 'Plant, controller and reference as processes over DDS, as fast as they go.',
        ('law', 'samples/s'),
        [[law, f'{lockstep_speed(law):.0f}'] for law in ('moving_horizon', 'lms')],
    )


def measure_simulation(_: float) -> Section:
    """Speed of the loop in one process."""
    noisy = {'output_noise_std': 1e-3}
    loops: dict[str, Mapping[str, object]] = {
        **{f'the example of the paper, {law}': {**noisy, 'estimator.law': law} for law in LAWS},
        'the same, moving_horizon, G exact': {**noisy, 'plant.uncertainty': 0.0},
        'the same, moving_horizon, tracking': {**noisy, 'structure': 'tracking'},
        'geared motor, tracking': {**motor(), 'structure': 'tracking'},
        'geared motor, proportional': {**motor(), 'structure': 'proportional'},
    }
    return Section(
        'Simulation',
        'The loop in one process, on one processor. The search for the backlash and the first fits '
        'of a growing record fall into the first samples.',
        ('loop', f'first {ACQUIRED} samples, samples/s', 'the others, samples/s'),
        [[name, *simulation_speeds(values)] for name, values in loops.items()],
    )


def simulation_speeds(values: Mapping[str, object]) -> list[str]:
    """Samples per second until the backlash is learned, and after that."""
    loop = build_closed_loop(Parameters(values))
    times = [time.perf_counter()]

    def note(k: int) -> None:
        if k + 1 in (ACQUIRED, SIMULATED_SAMPLES):
            times.append(time.perf_counter())

    loop.run(SIMULATED_SAMPLES, note)
    start, acquired, end = times
    return [f'{ACQUIRED / (acquired - start):.0f}',
            f'{(SIMULATED_SAMPLES - ACQUIRED) / (end - acquired):.0f}']


def measure_cost(duration_s: float) -> Section:
    """What the processes of a loop cost."""
    section = Section(
        'What it costs',
        'The default controller and `reference` as processes, beside a bare rclpy node that '
        'publishes every number it gets, at the same rate; once the backlash is known. Times are '
        'those of processors, of all threads; `its fits`: of the process that makes them.',
        COST_HEADER,
    )
    for rate in COST_RATES_HZ:
        rows, checks = measure_costs(rate, duration_s)
        section.rows += rows
        section.checks += checks
    return section


def measure_soak(duration_s: float) -> Section:
    """Samples that are lost at 1 kHz, and what the controller keeps."""
    return Section(
        'At 1 kHz', 'Plant, reference and controller as processes in real time.', CHECK_HEADER,
        checks=soak_checks(3.0 * duration_s),
    )


PARTS: dict[str, Callable[[float], Section]] = {
    'step': measure_steps, 'latency': measure_latencies, 'costs': measure_cost,
    'lockstep': measure_lockstep,
    'simulate': measure_simulation, 'soak': measure_soak,
}


def write_document(sections: list[Section]) -> None:
    """Write the results as Markdown."""
    paragraphs = [
        '# Performance: what was measured',
        f"Written by `make bench ARGS='--write'` on {machine()}. Ratios carry over to other "
        'machines, the times themselves do not.',
        '## Bounds and verdicts',
        markdown_table(CHECK_HEADER, [check.row for s in sections for check in s.checks]),
    ]
    for section in sections:
        if section.rows:
            paragraphs += [f'## {section.title}', section.explanation,
                           markdown_table(section.header, section.rows)]
    DOCUMENT.write_text('\n\n'.join(paragraphs) + '\n')


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
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
    return arguments


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    print(machine())
    sections: list[Section] = []
    for part in arguments.only:
        section = PARTS[part](arguments.duration)
        # Shown as soon as it is known: all of them take minutes.
        print(f'\n{section.title}')
        print(text_table(section.header, section.rows), flush=True)
        sections.append(section)
    checks = [check for section in sections for check in section.checks]
    if checks:
        print('\n' + text_table(CHECK_HEADER, [check.row for check in checks]))
    if arguments.write:
        write_document(sections)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
