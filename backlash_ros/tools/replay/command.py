"""`replay`: a recorded run through the controller once more, with other parameters if wanted."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from math import isfinite, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import Value
from backlash_ros.options import OptionParser
from backlash_ros.tools.cli import (
    InputError,
    Span,
    add_out_option,
    add_span_options,
    format_table,
    print_warnings,
    run_tool,
    span_of,
)
from backlash_ros.tools.records.columns import parse_columns

if TYPE_CHECKING:
    from backlash_ros.core.parameters import Parameters
    from backlash_ros.core.simulation.run_record import RunRecord

EXECUTABLE = 'replay'
FIGURE, TABLE = 'replay.png', 'replays.csv'
HEADER = ('run', 'changed', 'm', 'c_r', 'c_l', 'std_m', 'std_c_r', 'std_c_l', 'tracking from [s]',
          'innovation RMS')


class _Job(NamedTuple):
    """One replay. words: what of the parameters was changed. reports: as for `replay.replay`."""

    path: Path
    recorded: RunRecord
    parameters: Parameters
    words: str
    reports: Sequence[Sequence[float]]


def make_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = OptionParser(EXECUTABLE, description=__doc__)
    parser.add_argument('runs', type=Path, nargs='+', metavar='RUN',
                        help='a bag, a folder of results, or a log, as identify reads it, with '
                             '--config; several give a table')
    parser.add_argument('--columns', type=parse_columns, default={}, metavar='t=…,v=…,y=…',
                        help='which columns of a log these are (default: told by their names)')
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='parameters (default: parameters.yaml beside the run)')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE',
                        dest='settings', help='change one parameter; may be given again')
    parser.add_argument('--sweep', action='append', default=[], metavar='KEY=V1,V2,...',
                        help='once for each value; several sweeps: for each combination')
    parser.add_argument('--axis', default='', metavar='NAME', help='of a bag with several')
    add_span_options(parser)
    add_out_option(parser)
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `replay`."""
    return run_tool(EXECUTABLE, lambda: _replay(args))


def _replay(args: Sequence[str] | None) -> None:
    parser = make_parser()
    options = parser.parse_args(args)
    span = span_of(parser, options)
    from backlash_ros.tools.batch import combinations, parse_sweep, value_text
    changes = combinations([parse_sweep(text) for text in options.sweep])
    runs = [(path, *_opened(path, options, span)) for path in options.runs]
    jobs = []
    for path, recorded, parameters, reports in runs:
        for change in changes:
            changed = parameters.replaced(change) if change else parameters
            words = ' '.join(f'{name}={value_text(value)}' for name, value in change.items())
            jobs.append(_Job(path, recorded, changed, words, reports))
    if len(jobs) > 1:
        _several(jobs, options.out)
    else:
        _one(jobs[0], options.out)


def _opened(
    path: Path, options: argparse.Namespace, span: Span,
) -> tuple[RunRecord, Parameters, Sequence[Sequence[float]]]:
    """The run, the parameters with which it is to be replayed, and what its driver reported."""
    from backlash_ros.tools.records.reading import is_table
    from backlash_ros.tools.runs.files import SAMPLES_FILE
    if is_table(path) and path.name != SAMPLES_FILE:
        return _logged(path, options, span)
    from backlash_ros.tools.runs.read_run import read_run
    source = read_run(path.resolve(), options.config, span, options.axis)
    for text in source.notes:
        print(f'{EXECUTABLE}: warning: {text}', file=sys.stderr)
    if source.record.samples == 0:
        raise InputError(f'{path}: holds no sample')
    if source.parameters is None:
        raise InputError(f'{path}: no parameters.yaml stands beside it: give --config')
    parameters = _with_settings(source.parameters, options.settings)
    return source.record, parameters, _reports(path, source.record, parameters, options.axis)


def _logged(
    path: Path, options: argparse.Namespace, span: Span,
) -> tuple[RunRecord, Parameters, Sequence[Sequence[float]]]:
    """The same of a log: its v is what acted, in every interval."""
    from backlash_ros.tools.config import effective_parameters
    from backlash_ros.tools.records.reading import read_record
    from backlash_ros.tools.replay.logged_run import logged_run
    if options.config is None:
        raise InputError(f'{path}: is a log: give --config, like identified.yaml of `identify`')
    parameters = _with_settings(
        effective_parameters(options.config, axis=options.axis), options.settings
    ).replaced({'estimator.use_applied_control': 'true'})
    record = read_record(
        path, parameters.sample_period, span, columns=options.columns
    )
    for text in (record.timing, *record.notes):
        print(f'{EXECUTABLE}: {text}', file=sys.stderr)
    run, applied = logged_run(record)
    return run, parameters, applied


def _reports(
    path: Path, run: RunRecord, parameters: Parameters, axis: str,
) -> Sequence[Sequence[float]]:
    """What the driver said to have applied before each row, where the controller uses it."""
    from backlash_ros.core.loop.command_history import ReportUse, report_use
    from backlash_ros.tools.runs.bag import read_reports
    from backlash_ros.tools.runs.read_run import find_bag
    use = report_use(parameters)
    if use is ReportUse.NEVER:
        return ()
    bag = find_bag(path)
    reports = [] if bag is None else read_reports(bag, run.column('y'), axis)
    if not reports and use is ReportUse.ALWAYS:
        print(f'{EXECUTABLE}: warning: {path}: holds no applied_control: v is that of control',
              file=sys.stderr)
    return reports


def _with_settings(parameters: Parameters, settings: Sequence[str]) -> Parameters:
    from backlash_ros.tools.config import parse_setting
    changes: dict[str, Value] = {}
    for text in settings:
        setting = parse_setting(text)
        if setting.axis:
            raise InputError(f'--set {text!r}: leave out the axis: there is one run')
        changes[setting.name] = setting.value
    return parameters.replaced(changes) if changes else parameters


def _run(job: _Job, title: str) -> RunRecord:
    from tqdm import tqdm

    from backlash_ros.core.simulation.replay import replay
    from backlash_ros.tools.cli import BrokenOffError
    with tqdm(total=job.recorded.samples, file=sys.stderr, disable=None, leave=False, desc=title) \
            as bar:
        try:
            return replay(job.recorded, job.parameters, lambda _: bar.update(), job.reports)
        except ParameterError:
            raise
        except ValueError as error:
            raise BrokenOffError(f'the replay broke off: {error}') from error


def _one(job: _Job, out: Path | None) -> None:
    """What `simulate` writes, a figure beside it, and where the replay parts from the run."""
    recorded, parameters = job.recorded, job.parameters
    print_warnings(EXECUTABLE, parameters)
    replayed = _run(job, job.path.name)
    from backlash_ros.atomic_file import write_atomically
    from backlash_ros.tools.figures import png
    from backlash_ros.tools.replay.replay_figure import draw_replay
    from backlash_ros.tools.report import REPORT_PAGE, write_report
    from backlash_ros.tools.runs.files import Run, result_directory
    directory = result_directory(out)
    summary = write_report(Run(replayed, parameters), directory)
    write_atomically(directory / FIGURE, png(draw_replay(recorded, replayed)))
    print(format_table(('', 'run', 'replay', '±'), _compared(recorded, summary)))
    print(_states(replayed) if isnan(recorded.column('m')[-1]) else _parted(recorded, replayed))
    print(directory / FIGURE)
    print(directory / REPORT_PAGE)


def _compared(recorded: RunRecord, summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    return [
        (name, f'{recorded.column(name)[-1]:.6g}', f'{summary["final"][name]:.6g}',
         f'{summary["final_std"][name]:.2g}')
        for name in ('m', 'c_r', 'c_l')
    ]


def _states(run: RunRecord) -> str:
    """From when on which state held: all that a log, which has no estimates, is compared with."""
    import numpy as np

    from backlash_ros.core.estimate import Status
    status = run.column('status')
    begins = np.append(0, np.flatnonzero(np.diff(status)) + 1)
    shown = [f'{Status(int(status[k])).word} from {run.column("t")[k]:.3g} s' for k in begins[:8]]
    more = f', … ({len(begins)} in all)' if len(begins) > len(shown) else ''
    return f'states: {", ".join(shown)}{more}'


def _parted(recorded: RunRecord, replayed: RunRecord) -> str:
    from backlash_ros.core.simulation.replay import parting
    parted = parting(recorded, replayed)
    if parted is None:
        return 'the estimates are those of the run, to the last bit'
    return (
        f'the estimates part from those of the run at t = {parted.t:.4g} s: {parted.name} was '
        f'{parted.recorded:.6g} and is {parted.replayed:.6g}; by {parted.largest:.3g} standard '
        'deviations at most'
    )


def _several(jobs: Sequence[_Job], out: Path | None) -> None:
    """A table with a row for each run and each value."""
    from backlash_ros.tools.runs.files import result_directory, write_table
    rows: list[tuple[object, ...]] = []
    for job in jobs:
        replayed = _run(job, f'{job.path.name} {job.words}')
        rows.append((str(job.path), job.words, *_figures(replayed)))
    directory = result_directory(out)
    write_table(directory / TABLE, HEADER, rows)
    print(format_table(HEADER, [
        tuple(f'{cell:.4g}' if isinstance(cell, float) and isfinite(cell) else
              '–' if isinstance(cell, float) else str(cell) for cell in row) for row in rows
    ]))
    print(directory / TABLE)


def _figures(run: RunRecord) -> tuple[float, ...]:
    import numpy as np

    from backlash_ros.core.estimate import Status
    last = [float(run.column(name)[-1]) for name in HEADER[2:8]]
    tracking = np.flatnonzero(run.column('status') == Status.TRACKING)
    begins = float(run.column('t')[tracking[0]]) if len(tracking) else float('nan')
    innovation = run.column('innovation')[run.samples // 2:]
    known = innovation[np.isfinite(innovation)]
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else float('nan')
    return (*last, begins, rms)
