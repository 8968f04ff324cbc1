"""Measure how right, honest and quick the package is, and compare with a reference: the contract.

    make accuracy                              every row, against benchmarks/reference_accuracy.json
    make accuracy ARGS='--only bound faults'   some rows
    make accuracy ARGS='--scale 5'             five times as many runs, for smaller scatter
    make accuracy ARGS='--reference'           what was measured becomes the reference

Every row is a fixed set of seeded runs, and its figures have the scatter that other seeds would
show. What is worse than in the reference by more than three standard deviations ends it with 1.
"""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

# Before numpy is imported: the matrices are tiny, threads would only disturb the processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import faults
import ordinary_motions
from contract import following_rows, learning_rows, situation_rows, timing_rows
from contract.figures import COMPARED_HEADER, Figure, Row, as_json, compare, show
from reporting import ROOT, format_table, machine, markdown_table, parser_of
from tqdm import tqdm

REFERENCE = ROOT / 'benchmarks' / 'reference_accuracy.json'
PAGE = ROOT / 'docs' / 'results' / 'accuracy.md'
RESULT = ROOT / 'results' / 'accuracy.json'
WORKERS, NICENESS = 2, 5


class Measured(NamedTuple):
    """How a row is measured: its jobs for a scale, what each does, the figures of all results.

    alone: in this process, with nothing beside it, because it is about time.
    """

    jobs: Callable[[float], Sequence[Any]]
    run: Callable[[Any], Any]
    figures: Callable[[Sequence[Any]], Row]
    alone: bool = False


def row_of(module: Any, name: str, run: str = '', figures: str = '', **more: Any) -> Measured:
    """The row whose functions a module names after it."""
    return Measured(getattr(module, f'{name}_jobs'), getattr(module, run or f'run_{name}'),
                    getattr(module, f'{figures or name}_figures'), **more)


ROWS: dict[str, Measured] = {
    **{name: row_of(timing_rows, name, figures='times', alone=True)
       for name in ('step', 'latency', 'simulate', 'identify')},
    'bound': row_of(learning_rows, 'bound', 'run_job'),
    'losses': row_of(learning_rows, 'losses', 'run_job', 'bound'),
    'random': row_of(learning_rows, 'random'),
    **{f'plants, {loop} loop': row_of(learning_rows, 'plants', 'run_job')._replace(
        jobs=partial(learning_rows.plants_jobs, structure))
       for loop, structure in (('open', 'proportional'), ('closed', 'tracking'))},
    'changes': row_of(learning_rows, 'changes', 'run_job'),
    'following': row_of(following_rows, 'following'),
    'crossings': row_of(following_rows, 'crossings'),
    'late': row_of(situation_rows, 'late'),
    'faults': Measured(situation_rows.faults_jobs, faults.play, situation_rows.faults_figures),
    'identification': row_of(situation_rows, 'identification'),
    'gears': row_of(situation_rows, 'gears'),
    'ordinary motions': Measured(
        ordinary_motions.contract_cases, ordinary_motions.run_case,
        ordinary_motions.contract_figures),
}


def measure(name: str, scale: float, workers: int) -> Row:
    row = ROWS[name]
    jobs = row.jobs(scale)
    progress = partial(tqdm, desc=name, total=len(jobs), unit='run', disable=None)
    if row.alone:
        return row.figures([row.run(job) for job in progress(jobs)])
    # spawn: a fork of a process that has used DDS is none.
    with get_context('spawn').Pool(workers, _prepare) as pool:
        found = list(progress(pool.imap(row.run, jobs, chunksize=1)))
        pool.close()
        pool.join()  # so that their processor time counts
    return row.figures(found)


def _prepare() -> None:
    os.nice(NICENESS)
    warnings.simplefilter('ignore')


def read_rows(path: Path) -> dict[str, Row]:
    """Rows of a file of results; none where there is no file."""
    rows = json.loads(path.read_text())['rows'] if path.exists() else {}
    return {name: {what: Figure(**values) for what, values in row.items()}
            for name, row in rows.items()}


def write_rows(path: Path, rows: dict[str, Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {**read_rows(path), **rows}
    ordered = {name: kept[name] for name in ROWS if name in kept}
    path.write_text(json.dumps({'machine': machine(), 'rows': as_json(ordered)}, indent=1) + '\n')


HEAD = """# Accuracy: what was measured

Written by `make accuracy ARGS='--reference'`. `make accuracy` compares every change with these
figures, and fails where one is worse by more than three standard deviations: what stands after ±,
the scatter that other seeds would show. Errors are those of c_r or c_l, the worse one, in gaps.
*Beyond five deviations*: share of the *tracking* samples whose error is larger than five published
deviations; *wrong while tracking*: that, and more than 1 % of the gap. Times are in units of one
predict + update of a Kalman filter with six states, those over DDS in units of a bare echo node.
What each row is: [accuracy.py](../../benchmarks/accuracy.py).
The reference is that of the estimator before the present one, whose figures on ordinary motions
are in [estimation.md](../estimation.md#the-motions-of-most-machines)."""


def adopt(rows: dict[str, Row]) -> None:
    """Let these rows be the reference, and write it as Markdown."""
    write_rows(REFERENCE, rows)
    sections = [
        f'## {name.capitalize()}\n\n' + markdown_table(
            ('figure', 'value', 'runs'),
            [[what, show(one), str(one.runs)] for what, one in row.items()])
        for name, row in read_rows(REFERENCE).items()
    ]
    PAGE.write_text('\n\n'.join([HEAD, *sections]) + '\n')
    print(f'wrote {", ".join(rows)} into {REFERENCE.relative_to(ROOT)}')


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument('--only', nargs='+', metavar='ROW', default=list(ROWS),
                        help=f'of: {"; ".join(ROWS)}')
    parser.add_argument('--scale', type=float, default=1.0,
                        help='times as many runs as in the reference')
    parser.add_argument('--workers', type=int, default=WORKERS, metavar='N',
                        help=f'processes beside each other, default {WORKERS}')
    parser.add_argument('--out', type=Path, default=RESULT,
                        help='rows that it holds and that are not measured now stay in it')
    parser.add_argument('--reference', action='store_true',
                        help=f'write these rows into {REFERENCE.relative_to(ROOT)}')
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.only if name not in ROWS]:
        parser.error(f'--only {unknown[0]!r} must be of: {"; ".join(ROWS)}')
    if not (arguments.scale > 0.0 and arguments.workers > 0):
        parser.error('--scale and --workers must be > 0')
    before = read_rows(REFERENCE)
    rows: dict[str, Row] = {}
    for name in filter(arguments.only.__contains__, ROWS):
        begun, used = time.monotonic(), sum(os.times()[:4])
        rows[name] = row = measure(name, arguments.scale, arguments.workers)
        # Shown, and kept, as soon as it is known: all of them take minutes.
        print(f'\n{name} ({time.monotonic() - begun:.0f} s, of processors '
              f'{sum(os.times()[:4]) - used:.0f} s)')
        known = before.get(name, {})
        print(format_table(('figure', 'now', 'reference'), [
            [what, show(one), show(known[what]) if what in known else '–']
            for what, one in row.items()
        ]), flush=True)
        write_rows(arguments.out, {name: row})
    worse, better = compare(rows, before)
    for what, found in (('better', better), ('worse', worse)):
        print(f'\n{what} than the reference: {len(found) or "nothing"}')
        if found:
            print(format_table(COMPARED_HEADER, found))
    if arguments.reference:
        adopt(rows)
        return 0
    return 1 if worse else 0


if __name__ == '__main__':
    sys.exit(main())
