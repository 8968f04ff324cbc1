"""Measure how right, honest and quick the package is, and compare with a reference: the contract.

    make accuracy                              every row, against benchmarks/reference_accuracy.json
    make accuracy ARGS='--only bound faults'   some rows
    make accuracy ARGS='--scale 5'             five times as many runs, for smaller scatter
    make accuracy ARGS='--reference'           what was measured becomes the reference
    make accuracy ARGS='--reference FILE'      what another commit has measured, with --out FILE

Every row is a fixed set of seeded runs, and its figures have the scatter that other seeds would
show. What is worse than in the reference by more than three standard deviations ends it with 1.
Rows of time are compared with those of the same machine: their ratios do not carry over.
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
from contract.figures import COMPARED_HEADER, Row, as_json, compare, from_json, show
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
    return from_json(json.loads(path.read_text())['rows']) if path.exists() else {}


def write_rows(path: Path, rows: dict[str, Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {**read_rows(path), **rows}
    write_json(path, {'machine': machine(), 'rows': as_json(in_order(kept))})


def write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + '\n')


def in_order(rows: dict[str, Row]) -> dict[str, Row]:
    return {name: rows[name] for name in ROWS if name in rows}


HEAD = """# Accuracy: what was measured

Written by `make accuracy ARGS='--reference'`. `make accuracy` compares every change with these
figures, and fails where one is worse by more than three standard deviations: what stands after ±,
the scatter that other seeds would show. Errors are those of c_r or c_l, the worse one, in gaps.
*Beyond five deviations*: share of the *tracking* samples whose error is larger than five published
deviations; *wrong while tracking*: that, and more than 1 % of the gap. Times are in units of one
predict + update of a Kalman filter with six states, those over DDS in units of a bare echo node.
As these units do not carry over from one processor to another, there is a column for each: what
commit 0c6e90c4 measured there, and for `identify` 85dd56ba.
What each row is: [accuracy.py](../../benchmarks/accuracy.py).
The reference is that of the estimator before the present one, whose figures on ordinary motions
are in [estimation.md](../estimation.md#the-motions-of-most-machines)."""


class Reference(NamedTuple):
    """Rows that hold anywhere, and rows of time by the machine on which they were measured."""

    rows: dict[str, Row]
    times: dict[str, dict[str, Row]]

    @classmethod
    def read(cls) -> 'Reference':
        content = json.loads(REFERENCE.read_text())
        return cls(from_json(content['rows']),
                   {where: from_json(rows) for where, rows in content['times'].items()})

    def at(self, where: str) -> dict[str, Row]:
        return {**self.rows, **self.times.get(where, {})}

    def adopt(self, rows: dict[str, Row], where: str) -> None:
        """Take over rows that were measured on this machine, and write everything anew."""
        for name, row in rows.items():
            (self.times.setdefault(where, {}) if ROWS[name].alone else self.rows)[name] = row
        write_json(REFERENCE, {
            'rows': as_json(in_order(self.rows)),
            'times': {name: as_json(in_order(of)) for name, of in self.times.items()}})
        PAGE.write_text('\n\n'.join([HEAD, *map(self._section, ROWS)]) + '\n')
        print(f'wrote {", ".join(rows)} into {REFERENCE.relative_to(ROOT)}')

    def _section(self, name: str) -> str:
        columns = {where: rows[name] for where, rows in self.times.items() if name in rows} \
            if ROWS[name].alone else {'value': self.rows[name]}
        figures = dict.fromkeys(what for row in columns.values() for what in row)
        return f'## {name.capitalize()}\n\n' + markdown_table(
            ('figure', *columns, 'runs'),
            [[what, *(show(row[what]) if what in row else '–' for row in columns.values()),
              str(max(row[what].runs for row in columns.values() if what in row))]
             for what in figures])


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
    parser.add_argument('--reference', nargs='?', const=True, type=Path, metavar='FILE',
                        help='write these rows, or those that another commit has left in a file, '
                             f'into {REFERENCE.relative_to(ROOT)}')
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.only if name not in ROWS]:
        parser.error(f'--only {unknown[0]!r} must be of: {"; ".join(ROWS)}')
    if not (arguments.scale > 0.0 and arguments.workers > 0):
        parser.error('--scale and --workers must be > 0')
    reference = Reference.read()
    if isinstance(arguments.reference, Path):
        if not arguments.reference.exists():
            parser.error(f'--reference {arguments.reference}: there is no such file')
        of_another = json.loads(arguments.reference.read_text())
        reference.adopt(from_json(of_another['rows']), of_another['machine'])
        return 0
    before, rows = reference.at(machine()), dict[str, Row]()
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
    if unknown := [name for name in rows if name not in before]:
        print(f'\nnot compared, as nothing is known of this machine: {", ".join(unknown)}')
    worse, better = compare(rows, before)
    for what, found in (('better', better), ('worse', worse)):
        print(f'\n{what} than the reference: {len(found) or "nothing"}')
        if found:
            print(format_table(COMPARED_HEADER, found))
    if arguments.reference:
        reference.adopt(rows, machine())
        return 0
    return 1 if worse else 0


if __name__ == '__main__':
    sys.exit(main())
