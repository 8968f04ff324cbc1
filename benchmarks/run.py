"""Measure the package: time of a controller step, latency and rates through DDS, speed.

`make bench` runs everything; `make bench ARGS='--only step'` a part of it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

# Before numpy is imported: the matrices are tiny, threads would only disturb the loop.
os.environ.setdefault('OMP_NUM_THREADS', '1')

from real_time import loop_latency, reference_rate, step_times
from real_time.loop_latency import LATENCY_HEADER, RATES_HZ
from real_time.step_times import LAWS, MISSING, STEP_HEADER
from reporting import CHECK_HEADER, ROOT, Check, machine, markdown_table, text_table

from backlash_ros.core.control.controller import REFINE_SHARE
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.tools.config.configuration import load_config

DOCUMENT = ROOT / 'docs' / 'results' / 'performance.md'
DURATION_S = 20.0
LATENCY_LAWS = ('moving_horizon', 'lms')
SPEED_HEADER = ('law', 'samples/s')
SIMULATION_HEADER = (
    'loop', 'first 3,000 samples, samples/s', 'the next 9,000, samples/s', 'all, samples/s',
)
ACQUIRED, SIMULATED_SAMPLES = 3000, 12000
NOISE = {'output_noise_std': 1e-3}


@dataclass
class Section:
    """A table with what it shows, and the bounds it is held to."""

    title: str
    explanation: str
    header: tuple[str, ...]
    rows: list[list[str]] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)


def measure_steps(_: float) -> list[Section]:
    """Time of one controller step."""
    if not step_times.HAS_FILTER:
        print(MISSING)
    explanation = (
        'One whole controller step (estimator, structure, inverse) beside one predict + update '
        "of filterpy's KalmanFilter with six states, taking turns in the same loop."
    )
    laws = Section('Time of a controller step', explanation, STEP_HEADER)
    timings = step_times.law_timings()
    laws.rows = [timing.row for timing in timings]
    if step_times.HAS_FILTER:
        laws.checks = step_times.step_checks(timings)
    growth = Section(
        'Growth of the cost',
        'The default law with G of growing order, known exactly (no error terms) and with all '
        'error terms.', STEP_HEADER,
    )
    growth.rows = [timing.row for timing in step_times.order_timings()]
    after = Section(
        'Fits after the command',
        f'`refine`, which may take {REFINE_SHARE:.0%} of a sample period: the mean per '
        'sample, and the longest call.', step_times.REFINE_HEADER,
    )
    after.rows = step_times.refine_rows()
    return [laws, growth, after]


def measure_latency(duration_s: float) -> list[Section]:
    """Latency of the controller process."""
    sections = []
    for law in LATENCY_LAWS:
        section = Section(
            f'Latency from y to v, {law}',
            'The real controller process beside a bare rclpy node that publishes what it gets, '
            f'in alternating blocks of {loop_latency.BLOCK} samples, as seen by the driver that '
            'asks both.',
            LATENCY_HEADER,
        )
        latencies = [loop_latency.measure_latency(rate, law, duration_s) for rate in RATES_HZ]
        for item in latencies:
            section.rows += item.rows
            if item.unanswered:
                print(f'{law}, {item.rate:g} Hz: {item.unanswered} samples without an answer')
        section.checks = loop_latency.latency_checks(latencies, law)
        sections.append(section)
    return sections


def measure_reference(duration_s: float) -> list[Section]:
    """Messages of the reference per sample period."""
    section = Section(
        'Rate of the reference',
        'Messages on reference, counted by a node that does nothing else, at a sample period of '
        f'{1e3 * reference_rate.PERIOD_S:g} ms.', reference_rate.RATE_HEADER,
    )
    rates = reference_rate.measure_rates(duration_s)
    section.rows = [[what, str(count), f'{share:.3f}'] for what, count, share in rates]
    section.checks = reference_rate.rate_checks(rates)
    return [section]


def measure_lockstep(_: float) -> list[Section]:
    """Speed of lockstep."""
    section = Section(
        'Lockstep', 'Plant, controller and reference as processes over DDS, as fast as they go.',
        SPEED_HEADER,
    )
    section.rows = [[law, f'{loop_latency.lockstep_speed(law):.0f}'] for law in LATENCY_LAWS]
    return [section]


def measure_simulation(_: float) -> list[Section]:
    """Speed of the loop in one process."""
    section = Section(
        'Simulation',
        'The loop in one process, on one processor. The search for the backlash and the first fits '
        'of a growing record fall into the first samples.',
        SIMULATION_HEADER,
    )
    motor = load_config(ROOT / 'config' / 'geared_motor.yaml')
    exact: dict[str, object] = {'plant.uncertainty': 0.0}
    loops: dict[str, dict[str, object]] = {
        **{f'the example of the paper, {law}': {**NOISE, 'estimator.law': law} for law in LAWS},
        'the same, moving_horizon, G exact': {**NOISE, **exact},
        'the same, moving_horizon, tracking': {**NOISE, 'structure': 'tracking'},
        'geared motor, tracking': motor,
        'geared motor, tracking, G exact': {**motor, **exact},
        'geared motor, proportional': {**motor, 'structure': 'proportional'},
    }
    for name, values in loops.items():
        section.rows.append([name, *(f'{speed:.0f}' for speed in simulation_speeds(values))])
    return [section]


def simulation_speeds(values: Mapping[str, object]) -> tuple[float, float, float]:
    """Samples per second until the backlash is learned, after that, and over all of them."""
    loop = build_closed_loop(Parameters(values))
    times = [time.perf_counter()]

    def note(k: int) -> None:
        if k + 1 in (ACQUIRED, SIMULATED_SAMPLES):
            times.append(time.perf_counter())

    loop.run(SIMULATED_SAMPLES, note)
    start, acquired, end = times
    return (
        ACQUIRED / (acquired - start), (SIMULATED_SAMPLES - ACQUIRED) / (end - acquired),
        SIMULATED_SAMPLES / (end - start),
    )


PARTS: dict[str, Callable[[float], list[Section]]] = {
    'step': measure_steps, 'latency': measure_latency, 'reference': measure_reference,
    'lockstep': measure_lockstep, 'simulate': measure_simulation,
}


def write_document(path: Path, sections: list[Section]) -> None:
    """Write the results as Markdown."""
    paragraphs = [
        '# Performance: what was measured',
        f"Written by `make bench ARGS='--write'` on {machine()}. Ratios carry over to other "
        'machines, the times themselves do not.',
        '## Bounds and verdicts',
        markdown_table(CHECK_HEADER, [check.row for s in sections for check in s.checks]),
    ]
    for section in sections:
        paragraphs += [f'## {section.title}', section.explanation,
                       markdown_table(section.header, section.rows)]
    path.parent.mkdir(exist_ok=True)
    path.write_text('\n\n'.join(paragraphs) + '\n')


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', metavar='PART[,PART...]', default=','.join(PARTS),
                        help=f'parts to measure, of {", ".join(PARTS)}')
    parser.add_argument('--duration', type=float, default=DURATION_S, metavar='SECONDS',
                        help=f'of each measurement of latency, default {DURATION_S:g}')
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all parts')
    arguments = parser.parse_args()
    arguments.parts = arguments.only.split(',')
    unknown = [part for part in arguments.parts if part not in PARTS]
    if unknown:
        parser.error(f'--only {unknown[0]} must be of {", ".join(PARTS)}')
    if not arguments.duration > 0.0:
        parser.error(f'--duration {arguments.duration:g} must be > 0')
    if arguments.write and set(arguments.parts) != set(PARTS):
        parser.error('--write needs all parts: leave out --only')
    return arguments


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    print(machine())
    sections: list[Section] = []
    for part in arguments.parts:
        for section in PARTS[part](arguments.duration):
            # Shown as soon as it is known: all of them take minutes.
            print(f'\n{section.title}')
            print(text_table(section.header, section.rows), flush=True)
            sections.append(section)
    checks = [check for section in sections for check in section.checks]
    if checks:
        print('\n' + text_table(CHECK_HEADER, [check.row for check in checks]))
    if arguments.write:
        write_document(DOCUMENT, sections)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
