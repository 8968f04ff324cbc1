"""Measure the estimation of the backlash against its bounds.

All points, 200 seeds, 500 random cases:  python benchmarks/estimation.py
One point with few seeds:                 python benchmarks/estimation.py --point 2 --seeds 40
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

# Before numpy is imported: the matrices are tiny, threads would only disturb the processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')

from accuracy.estimation_points import ACCURACY_HEADER, CASES, HOUR, Benchmark, Outcome
from real_time.step_times import step_checks
from reporting import (
    CHECK_HEADER,
    ROOT,
    Check,
    markdown_table,
    processors,
    text_table,
)

DOCUMENT = ROOT / 'docs' / 'results' / 'estimation_results.md'
SEEDS, FIRST_SEED = 200, 1

POINTS: dict[int, Callable[[Benchmark], Outcome]] = {
    1: Benchmark.noise_free,
    2: Benchmark.efficiency,
    3: Benchmark.honesty,
    4: Benchmark.random_cases,
    5: Benchmark.imperfect_sensor,
    6: Benchmark.wear,
    7: Benchmark.unexcited,
    8: lambda _: Outcome(step_checks()),
}


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--point', type=int, action='append', choices=sorted(POINTS),
                        help='measure this point only; may be repeated')
    parser.add_argument('--seeds', type=int, default=SEEDS, help=f'default {SEEDS}')
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--cases', type=int, default=CASES, help=f'random cases, default {CASES}')
    parser.add_argument('--hour', type=int, default=HOUR, metavar='SAMPLES',
                        help=f'samples without excitation, default {HOUR}')
    parser.add_argument('--workers', type=int, default=processors())
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all points')
    arguments = parser.parse_args()
    if arguments.write and arguments.point:
        parser.error('--write needs all points: leave out --point')
    if min(arguments.seeds, arguments.cases, arguments.hour, arguments.workers) < 1:
        parser.error('--seeds, --cases, --hour and --workers must be >= 1')
    return arguments


def write_document(
    path: Path, benchmark: Benchmark, checks: list[Check], notes: list[str],
) -> None:
    """Write the results as Markdown."""
    options = ''.join(
        f' --{name} {value}' for name, value, default in (
            ('seeds', benchmark.seeds, SEEDS), ('first-seed', benchmark.first_seed, FIRST_SEED),
            ('cases', benchmark.cases, CASES), ('hour', benchmark.hour, HOUR),
        ) if value != default
    )
    command = f'python benchmarks/estimation.py --write{options}'
    paragraphs = [
        '# Estimation: what was measured',
        f'Written by `{command}`.',
        '## Accuracy, noise and time',
        'Root mean square error in per cent of the true value, in parentheses the Cramér–Rao '
        f'bound; {benchmark.seeds} seeds of the example, whose y swings ±0.25.',
        markdown_table(ACCURACY_HEADER, benchmark.accuracy_rows()),
        'The bound knows at every sample which side is engaged; the estimator has to find out. '
        'It is computed from the v that was applied, by code that shares nothing with the '
        'estimator (`benchmarks/accuracy/cramer_rao.py`).',
        '## Bounds and verdicts',
        markdown_table(CHECK_HEADER, [check.row for check in checks]),
    ]
    if notes:
        paragraphs += ['## Runs that fell short', '\n'.join(f'- {note}' for note in notes)]
    path.parent.mkdir(exist_ok=True)
    path.write_text('\n\n'.join(paragraphs) + '\n')


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    benchmark = Benchmark(
        arguments.seeds, arguments.first_seed, arguments.cases, arguments.hour, arguments.workers
    )
    checks: list[Check] = []
    notes: list[str] = []
    for point in arguments.point or sorted(POINTS):
        outcome = POINTS[point](benchmark)
        # Each point is shown as soon as it is known: all of them take minutes.
        print(f'point {point}')
        print(text_table(CHECK_HEADER, [check.row for check in outcome.checks]))
        print(''.join(f'    {note}\n' for note in outcome.notes), flush=True)
        checks += outcome.checks
        notes += [f'point {point}: {note}' for note in outcome.notes]
    if arguments.write:
        write_document(DOCUMENT, benchmark, checks, notes)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
