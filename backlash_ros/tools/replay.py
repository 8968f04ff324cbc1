"""`replay`: a recorded run through the controller once more, with other parameters if wanted."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from math import isnan, nan
from pathlib import Path
from typing import NamedTuple

import numpy as np

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.command_history import report_use
from backlash_ros.core.parameters import ParameterError, Parameters, as_yaml
from backlash_ros.core.simulation.closed_loop import parting, replay
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.options import OptionParser
from backlash_ros.tools import cli, figures
from backlash_ros.tools.batch import combinations
from backlash_ros.tools.config import parse_setting
from backlash_ros.tools.records.reading import read_run_or_log
from backlash_ros.tools.report import REPORT_PAGE, write_report
from backlash_ros.tools.runs.files import Run, result_directory, write_table
from backlash_ros.tools.runs.read_run import find_bag, read_reports
from backlash_ros.topics import BACKLASH


class Source(NamedTuple):
    """A recorded run, and what it is replayed with."""

    path: Path
    recorded: RunRecord
    parameters: Parameters
    reports: Sequence[Sequence[float]] = ()


def make_parser() -> argparse.ArgumentParser:
    parser = OptionParser('replay', description=__doc__)
    parser.add_argument('runs', type=Path, nargs='+', metavar='RUN',
                        help='a bag, a folder of results, or a log, as identify reads it, with '
                             '--config; several give a table')
    return cli.add_options(parser, '--config', '--set', '--columns', '--sweep', '--axis', '--from',
                           '--to', '--out')


def _replay(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    span, changes = cli.span_of(options), combinations(options.sweep)
    sources = [_opened(path, options, span) for path in options.runs]
    if len(sources) * len(changes) == 1:
        _one(sources[0], options.out)
        return
    rows: list[tuple[str | float, ...]] = []
    for source, change in product(sources, changes):
        words = ' '.join(f'{name}={as_yaml(value)}' for name, value in change.items())
        run = _replayed(source._replace(parameters=source.parameters.replaced(change)))
        tracking = run.column('t')[run.column('status') == Status.TRACKING].tolist()
        innovation = run.column('innovation')[run.samples // 2:]
        known = innovation[np.isfinite(innovation)]
        rows.append((
            str(source.path), words,
            *(float(run.column(std + name)[-1]) for std in ('', 'std_') for name in BACKLASH),
            next(iter(tracking), nan), float(np.sqrt(np.mean(known**2))) if len(known) else nan))
    header = ('run', 'changed', *BACKLASH, *(f'std_{name}' for name in BACKLASH),
              'tracking from [s]', 'innovation RMS')
    path = result_directory(options.out) / 'replays.csv'
    write_table(path, header, rows)
    print(cli.format_table(header, [
        [cell if isinstance(cell, str) else cli.number(cell) for cell in row] for row in rows]))
    print(path)


def _opened(path: Path, options: argparse.Namespace, span: cli.Span) -> Source:
    run, applied = read_run_or_log(path, options.config, span, options.axis, options.columns)
    for text in run.notes:
        print(f'replay: {"warning: " if applied is None else ""}{text}', file=sys.stderr)
    if run.parameters is None:
        raise cli.InputError(f'{path}: no parameters.yaml stands beside it: give --config, like '
                             'identified.yaml of `identify`')
    settings = list(map(parse_setting, options.settings))
    if any(axis for axis, *_ in settings):
        raise cli.InputError('--set: leave out the axis: there is one run')
    parameters = run.parameters.replaced({name: value for _, name, value in settings})
    if applied is not None:
        # Its v is what acted, in every interval.
        parameters = parameters.replaced({'estimator.use_applied_control': 'true'})
        return Source(path, run.record, parameters, applied)
    use, bag = report_use(parameters), find_bag(path)
    reports = read_reports(bag, run.record.column('y'), options.axis) \
        if use != 'false' and bag else []
    if use == 'true' and not reports:
        print(f'replay: warning: {path}: holds no applied_control: v is that of control',
              file=sys.stderr)
    return Source(path, run.record, parameters, reports)


def _replayed(source: Source) -> RunRecord:
    period, of_run = source.parameters.sample_period, source.recorded.sample_period
    if abs(period / of_run - 1.0) >= 0.01:
        raise ParameterError('sample_period', period, f'must be that of {source.path}, {of_run:g}')
    try:
        return replay(source.recorded, source.parameters, source.reports)
    except ParameterError:
        raise
    except ValueError as error:
        raise cli.BrokenOffError(f'the replay broke off: {error}') from error


def _one(source: Source, out: Path | None) -> None:
    recorded = source.recorded
    replayed = _replayed(source)
    cli.print_warnings('replay', source.parameters)
    directory = result_directory(out)
    summary = write_report(Run(replayed, source.parameters), directory)
    write_atomically(directory / 'replay.png',
                     figures.png(figures.draw_estimates(replayed, recorded)))
    print(cli.format_table(('', 'run', 'replay', '±'), [
        (name, cli.number(recorded.column(name)[-1], 6), cli.number(summary['final'][name], 6),
         cli.number(summary['final_std'][name], 2)) for name in BACKLASH
    ]))
    status, parted = replayed.column('status'), parting(recorded, replayed)
    if isnan(recorded.column('m')[-1]):  # of a log, which has no estimates to compare with
        begins = np.append(0, np.flatnonzero(np.diff(status)) + 1)
        states = [f'{Status(int(status[k])).word} from {replayed.column("t")[k]:.3g} s'
                  for k in begins[:8]]
        print(f'{len(begins)} states: {", ".join(states)}')
    elif parted is None:
        print('the estimates are those of the run, to the last bit')
    else:
        print(f'the estimates part from those of the run at t = {parted.t:.4g} s: {parted.name} '
              f'was {parted.recorded:.6g} and is {parted.replayed:.6g}; by {parted.largest:.3g} '
              'standard deviations at most')
    print(directory / 'replay.png', directory / REPORT_PAGE, sep='\n')


main = partial(cli.run_tool, 'replay', _replay)

if __name__ == '__main__':
    sys.exit(main())
