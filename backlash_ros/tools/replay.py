"""`replay`: run the controller again on a recorded run, with other parameters if wanted."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from math import nan
from pathlib import Path

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
from backlash_ros.tools.runs.summary import estimate_cells
from backlash_ros.topics import BACKLASH


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
    sources = [(path, *_opened(path, options, span)) for path in options.runs]
    if len(sources) * len(changes) == 1:
        [(path, source, parameters)] = sources
        _one(path, source, parameters.replaced(changes[0]), options.out)
        return
    rows: list[tuple[str | float, ...]] = []
    for (path, source, parameters), change in product(sources, changes):
        words = ' '.join(f'{name}={as_yaml(value)}' for name, value in change.items())
        run = _replayed(path, source, parameters.replaced(change))
        tracking = run.column('t')[run.column('status') == Status.TRACKING].tolist()
        innovation = run.column('innovation')[run.samples // 2:]
        known = innovation[np.isfinite(innovation)]
        rows.append((
            str(path), words,
            *(float(run.column(std + name)[-1]) for std in ('', 'std_') for name in BACKLASH),
            next(iter(tracking), nan), float(np.sqrt(np.mean(known**2))) if len(known) else nan))
    header = ('run', 'changed', *BACKLASH, *(f'std_{name}' for name in BACKLASH),
              'tracking from [s]', 'innovation RMS')
    file = result_directory(options.out) / 'replays.csv'
    write_table(file, header, rows)
    print(cli.format_table(header, [
        [cell if isinstance(cell, str) else cli.number(cell) for cell in row] for row in rows]))
    print(file)


def _opened(path: Path, options: argparse.Namespace, span: cli.Span) -> tuple[Run, Parameters]:
    """Read a recorded run or a log, and the parameters with which to replay it."""
    run = read_run_or_log(path, options.config, span, options.axis, options.columns)
    run.print_notes('replay')
    if run.parameters is None:
        raise cli.InputError(f'{path}: no parameters.yaml stands beside it: give --config, like '
                             'identified.yaml of `identify`')
    settings = list(map(parse_setting, options.settings))
    if any(axis for axis, *_ in settings):
        raise cli.InputError('--set: leave out the axis: there is one run')
    parameters = run.parameters.replaced({name: value for _, name, value in settings})
    if not run.record.has_estimates:  # the v of a log is what acted, in every interval
        parameters = parameters.replaced({'estimator.use_applied_control': 'true'})
    elif report_use(parameters) == 'true' and not run.applied:
        print(f'replay: warning: {path}: holds no applied_control: v is that of control',
              file=sys.stderr)
    return run, parameters


def _replayed(path: Path, source: Run, parameters: Parameters) -> RunRecord:
    period, of_run = parameters.sample_period, source.record.sample_period
    if abs(period / of_run - 1.0) >= 0.01:
        raise ParameterError('sample_period', period, f'must be that of {path}, {of_run:g}')
    try:
        return replay(source.record, parameters, source.applied)
    except ParameterError:
        raise
    except ValueError as error:
        raise cli.BrokenOffError(f'the replay broke off: {error}') from error


def _one(path: Path, source: Run, parameters: Parameters, out: Path | None) -> None:
    recorded, replayed = source.record, _replayed(path, source, parameters)
    cli.print_warnings('replay', parameters)
    directory = result_directory(out)
    summary = write_report(Run(replayed, parameters), directory)
    write_atomically(directory / 'replay.png',
                     figures.png(figures.draw_estimates(replayed, recorded)))
    print(cli.format_table(('', 'run', 'replay', '±'), [
        (name, cli.number(recorded.column(name)[-1], 6), *estimate_cells(summary, name)[:2])
        for name in BACKLASH]))
    status, parted = replayed.column('status'), parting(recorded, replayed)
    if not recorded.has_estimates:  # there are no estimates to compare with
        begins = np.append(0, np.flatnonzero(np.diff(status)) + 1)
        states = [f'{Status(int(status[k])).word} from {replayed.column("t")[k]:.3g} s'
                  for k in begins[:8]]
        print(f'{len(begins)} states: {", ".join(states)}')
    elif parted is None:
        print('the estimates are those of the run, to the last bit')
    else:
        print(f'the estimates differ from those of the run from t = {parted.t:.4g} s: {parted.name}'
              f' was {parted.recorded:.6g} and is {parted.replayed:.6g}; at most by '
              f'{parted.largest:.3g} standard deviations')
    print(directory / 'replay.png', directory / REPORT_PAGE, sep='\n')


main = partial(cli.run_tool, 'replay', _replay)

if __name__ == '__main__':
    sys.exit(main())
