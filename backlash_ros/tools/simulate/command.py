"""`simulate`: the controller and the plant in one process, once, for many seeds or in a sweep."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from tqdm import tqdm

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import Value
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.options import OptionParser
from backlash_ros.tools.cli import command_line
from backlash_ros.tools.cli.command_line import (
    DEFAULT_DURATION_S,
    format_table,
    number_of_samples,
    print_warnings,
)
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.tools.config.configuration import effective_parameters, write_config
from backlash_ros.tools.pages.html_page import relative_error
from backlash_ros.tools.run_files.results import CONFIG, result_directory, write_table
from backlash_ros.tools.simulate import batch
from backlash_ros.tools.simulate.batch import Job, Outcome
from backlash_ros.tools.simulate.cluster import run_on_cluster
from backlash_ros.tools.simulate.simulation import run_loop
from backlash_ros.tools.simulate.statistics import statistics
from backlash_ros.topics import BACKLASH

SEEDS, SWEEP, SWEEP_FIGURE = 'seeds.csv', 'sweep.csv', 'sweep.png'
NAMED_SEEDS = 10  # that an answer lists before it refers to the CSV


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `simulate`."""
    return command_line.run_tool('simulate', lambda: _simulate(args))


def make_parser() -> argparse.ArgumentParser:
    """The options of `simulate`."""
    parser = OptionParser('simulate', description=__doc__)
    command_line.add_common_options(parser)
    parser.add_argument(
        '--duration', type=float, metavar='SECONDS',
        help=f'length of a run (default: the parameter samples, or {DEFAULT_DURATION_S:g} s)',
    )
    parser.add_argument(
        '--seeds', type=int, metavar='N',
        help='run N seeds, from --seed on, in parallel and print their statistics',
    )
    parser.add_argument(
        '--sweep', action='append', default=[], metavar='KEY=v1,v2,...',
        help='run every value of a parameter; given again, every combination',
    )
    parser.add_argument(
        '--cluster', metavar='ADDRESS',
        help='let the workers of this Dask scheduler (tcp://HOST:PORT) do the runs of --seeds and '
             "--sweep; needs pip install 'backlash_ros[cluster]'",
    )
    return parser


def _simulate(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    parameters = effective_parameters(
        options.config, options.settings, options.seed, options.axis
    )
    if options.seeds is not None and options.seeds < 1:
        raise InputError(f'--seeds={options.seeds} must be >= 1')
    if options.seeds is None and not options.sweep:
        if options.cluster is not None:
            raise InputError('--cluster does many runs: give --seeds or --sweep as well')
        _once(parameters, options.duration, options.out)
    else:
        _many(parameters, options)


def _once(parameters: Parameters, duration: float | None, out: Path | None) -> None:
    # Drawing libraries take a second to load, which neither a worker nor bad input should cost.
    from backlash_ros.tools.report.command import PAGE, report_run
    samples = number_of_samples(parameters, duration)
    loop = build_closed_loop(parameters)
    print_warnings('simulate', parameters)
    _refuse_bad(out)
    # disable=None: no bar where stderr is not a terminal.
    with tqdm(total=samples, desc='simulate', unit='sample', disable=None) as bar:
        run = run_loop(loop, samples, lambda _: bar.update())
    directory = result_directory(out)
    summary = report_run(run, directory, parameters)
    print(run_table(summary))
    print(f'report: {directory / PAGE}')


def _refuse_bad(out: Path | None) -> None:
    """Fail before a long run, not after it; a folder of its own is made only for a whole run."""
    if out is not None:
        result_directory(out)


def run_table(summary: Mapping[str, Any], title: str = '') -> str:
    """Table of the estimates of one run, as text; title: of its first column."""
    rows = []
    for name in BACKLASH:
        final, truth = summary['final'][name], summary['truth'][name]
        std, settled = summary['final_std'][name], summary['settling_time_s'][name]
        rows.append((
            name, f'{final:.6g}', f'{std:.2g}' if isfinite(std) else '-',
            '-' if truth is None else f'{truth:.6g}', relative_error(final, truth),
            '-' if truth is None else 'never' if settled is None else f'{settled:.4g} s',
        ))
    return format_table((title, 'estimate', 'std', 'truth', 'error', 'within 1 % from'), rows)


def _many(parameters: Parameters, options: argparse.Namespace) -> None:
    sweeps = [batch.parse_sweep(text) for text in options.sweep]
    swept = [sweep.name for sweep in sweeps]
    if 'seed' in swept and options.seeds is not None:
        raise InputError('--seeds and --sweep seed=... exclude each other')
    changes = batch.combinations(sweeps)
    first = parameters.get_int('seed')
    seeds = range(first, first + (options.seeds or 1))
    jobs = batch.make_jobs(parameters, changes, seeds, options.duration)
    _refuse_bad(options.out)
    outcomes = batch.run_jobs(jobs, label='simulate') if options.cluster is None \
        else run_on_cluster(jobs, options.cluster, label='simulate')
    directory = result_directory(options.out)
    write_config(parameters, directory / CONFIG)
    csv = directory / (SWEEP if swept else SEEDS)
    write_table(csv, batch.outcome_header(swept), [
        batch.outcome_row(swept, job, outcome) for job, outcome in zip(jobs, outcomes, strict=True)
    ])
    if swept:
        groups = group(changes, outcomes)
        print(sweep_table(swept, groups))
        from backlash_ros.tools.pages.drawing import png
        from backlash_ros.tools.simulate.sweep_figure import draw_sweep
        write_atomically(directory / SWEEP_FIGURE, png(draw_sweep(sweeps, groups)))
        print(f'figure: {directory / SWEEP_FIGURE}')
    else:
        print(seeds_table(outcomes))
    for line in _shortfalls(jobs, outcomes):
        print(line)
    print(f'runs: {csv}')


def group(
    changes: Sequence[Mapping[str, Value]], outcomes: Sequence[Outcome],
) -> list[tuple[Mapping[str, Value], list[Outcome]]]:
    """Outcomes of each change; the jobs of one change stand together."""
    size = len(outcomes) // len(changes)
    return [
        (change, list(outcomes[i * size:(i + 1) * size])) for i, change in enumerate(changes)
    ]


def seeds_table(outcomes: Sequence[Outcome]) -> str:
    """Statistics of each parameter over the seeds, as text; raises InputError if all broke off."""
    header = ['', 'bias', 'RMSE', 'settled, median', 'settled, last', 'within 1 %']
    of = statistics(outcomes)
    known = all(isfinite(s.nees) for s in of.values())
    if known:
        low, high = of['m'].nees_interval
        header.append(f'NEES ({low:.2f} to {high:.2f})')
    rows = []
    for name, s in of.items():
        row = [name, f'{s.bias:+.3g}', f'{s.rmse:.3g}', _seconds(s.settling_median),
               _seconds(s.settling_max), f'{100.0 * s.within:.4g} %']
        rows.append([*row, f'{s.nees:.2f}'] if known else row)
    return format_table(header, rows)


def sweep_table(
    swept: Sequence[str], groups: Sequence[tuple[Mapping[str, Value], Sequence[Outcome]]],
) -> str:
    """A row for each combination: RMSE of each parameter, when the slowest settles, as text."""
    header = [*swept, *(f'RMSE {name}' for name in BACKLASH), 'settled, median', 'within 1 %']
    rows = []
    for change, outcomes in groups:
        row = [batch.value_text(change[name]) for name in swept]
        if all(outcome.problem for outcome in outcomes):
            rows.append([*row, *['-'] * 3, 'broke off', '-'])
            continue
        of = statistics(outcomes)
        rows.append([
            *row, *(f'{of[name].rmse:.3g}' for name in BACKLASH),
            _seconds(max(s.settling_median for s in of.values())),
            f'{100.0 * min(s.within for s in of.values()):.4g} %',
        ])
    return format_table(header, rows)


def _shortfalls(jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> list[str]:
    """Lines that name the runs that broke off or did not end within 1 %."""
    lines = []
    pairs = list(zip(jobs, outcomes, strict=True))
    broken = [job for job, outcome in pairs if outcome.problem]
    if broken:
        first = next(outcome.problem for outcome in outcomes if outcome.problem)
        lines.append(f'broke off: {_seeds(broken)}, the first one with: {first}')
    missed = [
        job for job, outcome in pairs
        if not outcome.problem and not all(isfinite(time) for time in outcome.settling)
    ]
    if missed:
        lines.append(f'not within 1 % at the end: {_seeds(missed)}')
    return lines


def _seeds(jobs: Sequence[Job]) -> str:
    named = list(dict.fromkeys(str(job.values['seed']) for job in jobs))
    more = ', ...' if len(named) > NAMED_SEEDS else ''
    return f'{len(jobs)} runs, seed {", ".join(named[:NAMED_SEEDS])}{more}'


def _seconds(time: float) -> str:
    return f'{time:.4g} s' if isfinite(time) else 'never'
