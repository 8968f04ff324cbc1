"""Measure what is learned where the true plant differs from the G(z) that is told.

Every plant, 20 backlashes each:   python benchmarks/uncertain_plants.py
Point 1, a few plants:              python benchmarks/uncertain_plants.py --point 1 --cases 1.2

In simulation: config/geared_motor.yaml with the parameters truth.*; y is quantised as there.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

# Before numpy is imported: the matrices are tiny, threads would only disturb the processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from accuracy.uncertain_points import CASE_HEADER, POINTS, Benchmark
from reporting import CHECK_HEADER, ROOT, Check, markdown_table, processors, text_table

DOCUMENT = ROOT / 'docs' / 'results' / 'uncertain_plants.md'
BACKLASHES, FIRST_SEED = 20, 1
NOTES_SHOWN = 12


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--point', type=int, action='append', choices=sorted(POINTS),
                        help='measure this point only; may be repeated')
    parser.add_argument('--cases', action='append', default=[], metavar='WORDS',
                        help='only cases whose name holds this; may be repeated')
    parser.add_argument('--backlashes', type=int, default=BACKLASHES, metavar='N',
                        help=f'random backlashes for each plant, default {BACKLASHES}')
    parser.add_argument('--seed', type=int, default=FIRST_SEED,
                        help=f'of the first backlash, default {FIRST_SEED}')
    parser.add_argument('--processes', type=int, default=processors())
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all points and cases')
    arguments = parser.parse_args()
    if arguments.write and (arguments.point or arguments.cases):
        parser.error('--write needs all points and cases: leave out --point and --cases')
    if min(arguments.backlashes, arguments.processes) < 1 or arguments.seed < 0:
        parser.error('--backlashes and --processes must be >= 1, --seed >= 0')
    return arguments


def merged_rows(rows: Mapping[str, Sequence[Sequence[str]]]) -> list[list[str]]:
    """A line for each case from what several points say of it."""
    return [
        [name, *(next((cell for cell in cells if cell != '–'), '–')
                 for cells in zip(*parts, strict=True))]
        for name, parts in rows.items()
    ]


def write_document(
    path: Path, arguments: argparse.Namespace, checks: list[Check], rows: list[list[str]],
    notes: list[str],
) -> None:
    """Write the results as Markdown."""
    options = ''.join(
        f' --{name} {value}' for name, value, default in (
            ('backlashes', arguments.backlashes, BACKLASHES), ('seed', arguments.seed, FIRST_SEED),
        ) if value != default
    )
    paragraphs = [
        '# Plants that differ from G(z): what was measured',
        f'Written by `python benchmarks/uncertain_plants.py --write{options}`.',
        '## Bounds and verdicts',
        markdown_table(CHECK_HEADER, [check.row for check in checks]),
        '## Plant by plant',
        f'config/geared_motor.yaml with the true plant of each line, {arguments.backlashes} random '
        'backlashes. c: the worse of c_r and c_l, error relative to its own true value. y: RMS of '
        'y − y_m(k − preview) from 4 s on in `structure: tracking`, divided by that of the same '
        'loop which is given the true backlash and the true G(z).',
        markdown_table(CASE_HEADER, rows),
    ]
    if notes:
        paragraphs += ['## Runs that fell short, and remarks',
                       '\n'.join(f'- {note}' for note in notes)]
    path.write_text('\n\n'.join(paragraphs) + '\n', encoding='utf-8')


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    seeds = range(arguments.seed, arguments.seed + arguments.backlashes)
    benchmark = Benchmark(seeds, arguments.cases, arguments.processes)
    checks: list[Check] = []
    notes: list[str] = []
    rows: dict[str, list[list[str]]] = {}
    for point in arguments.point or sorted(POINTS):
        outcome = POINTS[point](benchmark)
        # Each point is shown as soon as it is known: all of them take minutes.
        print(f'point {point}')
        print(text_table(CHECK_HEADER, [check.row for check in outcome.checks]))
        if outcome.rows:
            table = [[name, *cells] for name, cells in outcome.rows.items()]
            print('\n' + text_table(CASE_HEADER, table))
        print(''.join(f'    {note}\n' for note in outcome.notes[:NOTES_SHOWN]), end='')
        if len(outcome.notes) > NOTES_SHOWN:
            print(f'    ... and {len(outcome.notes) - NOTES_SHOWN} more')
        print(flush=True)
        checks += outcome.checks
        notes += [f'point {point}: {note}' for note in outcome.notes]
        for name, cells in outcome.rows.items():
            rows.setdefault(name, []).append(cells)
    if arguments.write:
        write_document(DOCUMENT, arguments, checks, merged_rows(rows), notes)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
