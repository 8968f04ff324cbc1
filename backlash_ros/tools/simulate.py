"""`simulate`: run controller and plant in one process, once, for many seeds, or in a sweep."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from math import inf

from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.diagnosis import Learning, LoopFigures, Neighbours, state_beside
from backlash_ros.core.loop.sample_counter import Timing
from backlash_ros.core.parameters import Parameters, as_yaml
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.options import OptionParser
from backlash_ros.tools import batch, cli
from backlash_ros.tools.config import read_configuration, write_config
from backlash_ros.tools.runs.files import (
    CONFIG_FILE,
    Run,
    result_directory,
    results_folder,
    write_table,
)
from backlash_ros.tools.runs.read_run import run_loop
from backlash_ros.tools.runs.summary import estimate_table
from backlash_ros.topics import BACKLASH


def make_parser() -> argparse.ArgumentParser:
    parser = OptionParser('simulate', description=__doc__)
    cli.add_options(
        parser, '--config', '--set', '--axis', '--seed', '--out', '--duration', '--sweep')
    parser.add_argument('--seeds', type=int, metavar='N', help='run N seeds, from --seed on, in '
                        'parallel and print their statistics')
    parser.add_argument('--cluster', metavar='ADDRESS', help='let the workers of this Dask '
                        'scheduler (tcp://HOST:PORT) do the runs of --seeds and --sweep; needs '
                        '`pip install distributed`')
    return parser


def _simulate(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    configuration = read_configuration(options.config, options.settings, options.seed)
    parameters = configuration.parameters(options.axis)
    if options.seeds is not None and options.seeds < 1:
        raise cli.InputError(f'--seeds={options.seeds} must be >= 1')
    many = options.seeds is not None or options.sweep or options.cluster is not None
    (_many if many else _once)(parameters, options)


def _once(parameters: Parameters, options: argparse.Namespace) -> None:
    # Imported here, as drawing libraries take a second to load, which workers need not.
    from backlash_ros.tools.report import REPORT_PAGE, write_report
    samples = cli.number_of_samples(parameters, options.duration)
    loop = build_closed_loop(parameters)
    cli.print_warnings('simulate', parameters)
    results_folder(options.out)
    run = run_loop(loop, samples)
    directory = result_directory(options.out)
    print(estimate_table(write_report(Run(run, parameters), directory)))
    law = loop.controller.estimator
    if law.estimate.status != Status.TRACKING:
        state = state_beside(set(), LoopFigures(
            timing=Timing(parameters.sample_period), around=Neighbours(),
            learning=Learning(law.estimate.status, law.report)))
        print(f'at the end: {state.text}')
    print(f'report: {directory / REPORT_PAGE}')


def _many(parameters: Parameters, options: argparse.Namespace) -> None:
    changes = batch.combinations(options.sweep)
    swept = list(changes[0])
    if 'seed' in swept and options.seeds is not None:
        raise cli.InputError('--seeds and --sweep seed=... exclude each other')
    seeds = range(parameters.seed, parameters.seed + (options.seeds or 1))
    jobs = batch.make_jobs(parameters, changes, seeds, options.duration)
    results_folder(options.out)
    outcomes = batch.run_jobs(jobs, cluster=options.cluster, label='simulate')
    directory = result_directory(options.out)
    write_config(parameters, directory / CONFIG_FILE)
    csv = directory / ('sweep.csv' if swept else 'seeds.csv')
    write_table(csv, (*swept, 'seed', *batch.OUTCOME_COLUMNS), [
        [*(as_yaml(run[name]) for name in (*swept, 'seed')), *outcome.values()]
        for (run, _), outcome in zip(jobs, outcomes, strict=True)])
    size = len(outcomes) // len(changes)  # the jobs of one change stand together
    rows = []
    for i, change in enumerate(changes):
        group, values = outcomes[i * size:][:size], list(map(as_yaml, change.values()))
        if len(changes) > 1 and all(outcome['problem'] for outcome in group):
            rows.append([*values, 'broke off', *[cli.NOTHING] * len(batch.STATISTICS)])
            continue
        rows += [[
            *values, name, f'{bias:+.3g}', f'{rmse:.3g}',
            *('never' if time == inf else f'{time:.4g} s' for time in settled),
            f'{100.0 * within:.4g} %',
        ] for name, (bias, rmse, *settled, within) in batch.statistics(group).items()]
    print(cli.format_table([*swept, '', *batch.STATISTICS], rows))
    named: dict[str, list[int]] = {}
    for (run, _), outcome in zip(jobs, outcomes, strict=True):
        if outcome['problem']:
            named.setdefault(f'broke off ({outcome["problem"]})', []).append(run.seed)
        elif None in [outcome[f'settling_{name}'] for name in BACKLASH]:
            named.setdefault('not within 1 % at the end', []).append(run.seed)
    for what, affected in named.items():
        print(f'{what}: {len(affected)} runs, seed {", ".join(map(str, dict.fromkeys(affected)))}')
    print(f'runs: {csv}')


main = partial(cli.run_tool, 'simulate', _simulate)

if __name__ == '__main__':
    sys.exit(main())
