"""Learning from the example driver while both processes are held up, in simulated time.

    python benchmarks/held_up_processes.py [--seeds 12] [--seconds 6] [--processes 2] [--write]

accuracy/simulated_processes.py simulates examples/motor_driver.py and the controller with
config/geared_motor.yaml. Unlike loaded_machine.py, which runs real processes beside a busy loop,
this does not depend on the machine: every seed gives the same on all.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from math import inf
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from accuracy.motor_crossings import BOUND_S, LIMITS, crossing_error
from accuracy.simulated_processes import WAITS, HeldUpProcesses
from reporting import (
    CHECK_HEADER,
    ROOT,
    Check,
    markdown_table,
    parallel,
    processors,
    text_table,
)

from backlash_ros.core.estimate import Status
from backlash_ros.tools.config.configuration import effective_parameters

CONFIG = Path('geared_motor.yaml')
DOCUMENT = ROOT / 'docs' / 'results' / 'held_up_processes.md'
SEEDS, SECONDS = 12, 6.0
LOADS = (0.4, 1.0)
MOST_OFF = 5.0  # deviations of a wrong estimate


class Case(NamedTuple):
    """How much the processes are held up, and what is done with what the driver reports."""

    load: float
    use: str


class Run(NamedTuple):
    """What became of one run, as to the relative error of c_r and c_l, the larger one.

    settled_s: from when on it stays within the limit. at_end: of the last answer. wrong_s: time
    for which it was tracking and more than MOST_OFF deviations off. late, lost: share of the
    commands that came after their sample, and of the outputs that never came.
    """

    settled_s: float
    at_end: float
    wrong_s: float
    late: float
    lost: float


def run(job: tuple[Case, int], seconds: float) -> Run:
    """One seed of a case."""
    case, seed = job
    p = effective_parameters(CONFIG, [f'estimator.use_applied_control={case.use}'])
    processes = HeldUpProcesses(p, case.load, seed, reports=case.use != 'false')
    heard = processes.run(seconds)
    settled_s, wrong, at_end = 0.0, 0, inf
    for time_s, e in heard:
        at_end, off = crossing_error(e.c_r, e.c_l, e.std_c_r, e.std_c_l)
        if not at_end <= LIMITS[case.use]:
            settled_s = time_s
        wrong += e.status is Status.TRACKING and off > MOST_OFF
    loop, samples = processes.loop, seconds / processes.period
    return Run(
        settled_s, at_end, wrong * processes.period, loop.commands.late / len(heard),
        loop.statistics.lost / samples,
    )


def judge(case: Case, runs: Sequence[Run]) -> Check:
    """The bound for one case."""
    settled = np.array([each.settled_s for each in runs])
    limit = LIMITS[case.use]
    return Check(
        f'load {case.load:g}, use_applied_control {case.use}, {len(runs)} seeds: c_r and c_l '
        f'within {limit:.0%} from [s]', f'<= {BOUND_S:g}',
        f'median {np.median(settled):.2f}, worst {settled.max():.2f}', settled.max() <= BOUND_S,
    )


ROW_HEADER = (
    'load', 'reports', 'commands late', 'outputs lost', 'error at the end, median', 'worst',
    'wrong by 5 deviations [s], worst',
)


def row(case: Case, runs: Sequence[Run]) -> list[str]:
    """Cells of the table of cases."""
    errors = [each.at_end for each in runs]
    return [
        f'{case.load:g}', case.use, f'{np.mean([each.late for each in runs]):.0%}',
        f'{np.mean([each.lost for each in runs]):.0%}', f'{np.median(errors):.3%}',
        f'{max(errors):.3%}', f'{max(each.wrong_s for each in runs):.2f}',
    ]


def parse_arguments() -> argparse.Namespace:
    """Options of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=SEEDS, help=f'of each case, default {SEEDS}')
    parser.add_argument('--first', type=int, default=1, help='first seed, default 1')
    parser.add_argument('--seconds', type=float, default=SECONDS,
                        help=f'of each run, default {SECONDS:g}')
    parser.add_argument('--load', type=float, action='append',
                        help=f'instead of {LOADS}; 0 is an idle machine; may be repeated')
    parser.add_argument('--use', action='append', choices=sorted(LIMITS),
                        help='estimator.use_applied_control instead of both; may be repeated')
    parser.add_argument('--processes', type=int, default=processors(),
                        help='at a time, default one for every processor')
    parser.add_argument('--write', action='store_true',
                        help=f'write {DOCUMENT.relative_to(ROOT)}; needs all loads and both uses')
    arguments = parser.parse_args()
    if arguments.seeds < 1 or not arguments.seconds > BOUND_S:
        parser.error(f'--seeds must be >= 1 and --seconds > {BOUND_S:g}')
    if not all(0.0 <= load <= 2.0 for load in arguments.load or ()):
        parser.error('--load must be >= 0 and <= 2')
    if arguments.write and (arguments.load or arguments.use):
        parser.error('--write needs all loads and uses: leave out --load and --use')
    return arguments


def write_document(checks: Sequence[Check], rows: Sequence[Sequence[str]], seconds: float) -> None:
    """Write the results as Markdown."""
    waits = ', '.join(f'{1e3 * longest:g} ms in {share:.1%}' for share, longest in reversed(WAITS))
    DOCUMENT.write_text('\n\n'.join([
        '# Learning while processes are held up',
        'Written by `python benchmarks/held_up_processes.py --write`. The example driver and the '
        f'controller with config/geared_motor.yaml in simulated time, {seconds:g} s of each seed. '
        f'At load 1 either of them waits for up to {waits} of its turns, at other loads in so many '
        'times that share; the sample period is 5 ms.',
        markdown_table(CHECK_HEADER, [check.row for check in checks]),
        '*reports*: `estimator.use_applied_control`. *error*: the larger one of c_r and c_l, '
        'relative. *wrong*: *tracking*, and off by more than five published deviations.',
        markdown_table(ROW_HEADER, rows),
    ]) + '\n', encoding='utf-8')


def main() -> int:
    """Return 0 if every bound holds, else 1."""
    arguments = parse_arguments()
    cases = [Case(*pair) for pair in product(arguments.load or LOADS, arguments.use or LIMITS)]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    jobs = list(product(cases, seeds))
    found = parallel(partial(run, seconds=arguments.seconds), jobs, 'runs', arguments.processes)
    runs = {
        case: [each for (of, _), each in zip(jobs, found, strict=True) if of == case]
        for case in cases
    }
    checks = [judge(case, runs[case]) for case in cases]
    rows = [row(case, runs[case]) for case in cases]
    print(text_table(ROW_HEADER, rows))
    print()
    print(text_table(CHECK_HEADER, [check.row for check in checks]))
    if arguments.write:
        write_document(checks, rows, arguments.seconds)
        print(f'wrote {DOCUMENT.relative_to(ROOT)}')
    return 0 if all(check.holds for check in checks) else 1


if __name__ == '__main__':
    sys.exit(main())
