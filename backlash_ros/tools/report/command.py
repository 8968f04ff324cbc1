"""`report`: from a bag or saved results to report.html, figures and summary.json."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backlash_ros.atomic_file import write_atomically
from backlash_ros.bags.content import is_bag
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.options import OptionParser
from backlash_ros.tools.cli.command_line import (
    add_out_option,
    add_span_options,
    run_tool,
    span_of,
)
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.tools.config.configuration import effective_parameters, load_config, write_config
from backlash_ros.tools.pages.drawing import png
from backlash_ros.tools.pages.html_page import Picture, render_page
from backlash_ros.tools.report import figures
from backlash_ros.tools.report.analysis import (
    compare_laws,
    compared_samples,
    followed_reference,
    interesting_parts,
)
from backlash_ros.tools.run_files.bag_reading import read_bag
from backlash_ros.tools.run_files.bag_sections import WHOLE, Span
from backlash_ros.tools.run_files.results import (
    CONFIG,
    RECORD,
    SAMPLES,
    SUMMARY,
    read_record,
    read_samples,
    result_directory,
    summarise,
    write_run,
    write_summary,
)
from backlash_ros.topics import BACKLASH

PAGE = 'report.html'
BAG = 'bag'
TITLE = 'Adaptive backlash inverse control'
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """A run to report on, and what is known about it."""

    run: RunRecord
    parameters: Parameters | None
    latency_s: Array | None = None
    warnings: tuple[str, ...] = ()
    damage: str = ''  # of the bag it was read from
    notes: tuple[str, ...] = ()  # what else is in the bag


def report_bag(bag: Path, out: Path, parameters: Parameters | None) -> dict[str, Any]:
    """Write report, figures, samples.csv and summary.json of a bag to out; return the summary.

    Says on stderr if the bag is damaged. Raises InputError for a bag without a run.
    """
    source = _from_bag(bag, parameters)
    _tell_damage(source)
    return _write(source, out)


def report_run(run: RunRecord, out: Path, parameters: Parameters) -> dict[str, Any]:
    """Write report, figures, samples.csv and summary.json of a simulation to out."""
    return _write(Source(run, parameters), out)


def _from_bag(
    bag: Path, parameters: Parameters | None, span: Span = WHOLE, axis: str = '',
) -> Source:
    period = parameters.get_float('sample_period') if parameters else None
    found = read_bag(bag, period, span, axis)
    warnings = [f'The bag: {note}.' for note in found.notes]
    if found.damage:
        warnings.append(f'The bag {found.damage}')
    if found.unpaired:
        warnings.append(
            f'{found.unpaired} samples were left out: only one of signals and estimates is in '
            'the bag.'
        )
    if parameters is None:
        warnings.append(
            f'The sample period of {found.run.sample_period:.6g} s was taken from the stamps of '
            'the bag: no parameters were given.'
        )
    return Source(
        found.run, parameters, found.latency_s, tuple(warnings), found.damage, found.notes
    )


def _tell_damage(source: Source) -> None:
    for text in (source.damage, *source.notes):
        if text:
            print(f'report: warning: {text}', file=sys.stderr)


def _write(source: Source, out: Path) -> dict[str, Any]:
    summary = summarise(source.run, source.parameters, source.latency_s)
    write_run(source.run, out)
    write_summary(summary, out / SUMMARY)
    configuration = None
    if source.parameters is not None:
        write_config(source.parameters, out / CONFIG)
        configuration = (out / CONFIG).read_text(encoding='utf-8')
    pictures = list(draw(source, summary))
    for picture in pictures:
        write_atomically(out / picture.name, picture.data)
    page = render_page(TITLE, summary, pictures, source.warnings, configuration)
    write_atomically(out / PAGE, page)
    return summary


def draw(source: Source, summary: dict[str, Any]) -> Iterable[Picture]:
    """Every figure that this run allows, in the order of the page."""
    run, parameters = source.run, source.parameters
    start, end = parts = interesting_parts(run, parameters)
    if run.has_truth:
        yield Picture(
            'parameter_errors.png', 'Parameter errors over time (Figure 4 of the paper)',
            'How far the estimates are from the hidden backlash, and in percent of it. A dot marks '
            'the time from which the error stays within 1 %.',
            png(figures.draw_parameter_errors(run, start, summary['settling_time_s'])),
        )
    yield Picture(
        'estimates.png', 'Estimates over time',
        'What the controller has learned from v and y alone; a band shows how sure it is where '
        'the law knows.', png(figures.draw_estimates(run)),
    )
    if np.isfinite(run.column('u')).any():
        yield Picture(
            'control_error.png', 'Control error of this run',
            'e = u − u<sub>d</sub> (3.4): what the inverse leaves of the backlash.',
            png(figures.draw_control_error(run, parts)),
        )
    elif np.isfinite(run.column('innovation')).any():
        yield Picture(
            'innovation.png', 'Innovation',
            'y minus its prediction. White and small: the model explains the plant.',
            png(figures.draw_innovation(run, end)),
        )
    if run.has_truth and parameters is not None:
        duration = compared_samples(run) * run.sample_period
        yield Picture(
            'laws.png', 'Control error of the laws (Figure 5 of the paper)',
            'This run beside the other laws, simulated with the same parameters, over the first '
            f'{duration:.6g} s. Each has its own scale; the last panel has all on one.',
            png(figures.draw_laws(compare_laws(run, parameters), start)),
        )
    yield Picture(
        'hysteresis.png', 'Backlash: the v–u loop',
        'u follows the right line going up, the left line going down, and is held between them. '
        'A dashed line on the wide one: the estimate is right.' if run.has_truth else
        'The loop as the last estimates see it: u itself was not measured.',
        png(figures.draw_hysteresis(run, end)),
    )
    reference = followed_reference(run, parameters)
    yield Picture(
        'output.png', 'Reference and output',
        'y follows y<sub>m</sub>.' if reference.followed else
        'Each on its own scale: y does not follow y<sub>m</sub>, which the structure '
        'u<sub>d</sub> = y<sub>m</sub> + f v does not aim at.',
        png(figures.draw_output(run, end, reference)),
    )
    yield Picture(
        'input.png', 'Desired input and control',
        'v jumps by the width of the gap whenever u<sub>d</sub> turns.',
        png(figures.draw_input(run, parts)),
    )


def open_source(
    path: Path, config: Path | None = None, span: Span = WHOLE, axis: str = '',
) -> Source:
    """Read a bag, a folder of results, record.npz or samples.csv; raises InputError.

    config: parameters of the run; None looks for parameters.yaml beside it. span, axis: the part
    that is wanted, where there are several.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    parameters = _parameters_beside(path) if config is None else effective_parameters(config)
    if path.is_dir():
        for folder in (path, path / BAG):
            if is_bag(folder):
                return _from_bag(folder, parameters, span, axis)
        if (path / RECORD).is_file():
            path = path / RECORD
        elif (path / SAMPLES).is_file():
            path = path / SAMPLES
        else:
            raise InputError(f'{path}: holds no bag, no {RECORD} and no {SAMPLES}')
    if path.suffix == '.npz':
        return Source(_part(read_record(path), span), parameters)
    if path.suffix != '.csv':
        raise InputError(f'{path}: is no bag folder, no results folder and no {SAMPLES}')
    run = read_samples(path, parameters.get_float('sample_period') if parameters else None)
    run = _part(_with_truth(run, path.parent / SUMMARY, parameters), span)
    return Source(run, parameters)


def _part(run: RunRecord, span: Span) -> RunRecord:
    """The rows of the span, their time counted from its first one."""
    if span == WHOLE:
        return run
    t = run.column('t')
    rows = run.rows[(t >= span.from_s) & (t < span.to_s)].copy()
    if not len(rows):
        raise InputError('there is no sample between --from and --to')
    rows[:, COLUMNS.index('t')] -= rows[0, COLUMNS.index('t')]
    # Of G it is known what was believed at the end.
    learned = run.learned if t[-1] < span.to_s else None
    return RunRecord(rows, run.sample_period, run.lost_samples, learned)


def _parameters_beside(path: Path) -> Parameters | None:
    folder = path if path.is_dir() else path.parent
    # A bag lies in the folder of the results to which the parameters belong.
    for place in (folder, folder.parent) if is_bag(folder) else (folder,):
        if (place / CONFIG).is_file():
            return Parameters(load_config(place / CONFIG))
    return None


def _with_truth(run: RunRecord, summary: Path, parameters: Parameters | None) -> RunRecord:
    """The run with the truth of its summary.json, unless the truth changed on the way."""
    wears = parameters is None or any(
        any(parameters.get_triple(name)) for name in ('backlash.rate', 'backlash.jump'))
    if wears or not summary.is_file():
        return run
    try:
        truth = json.loads(summary.read_text(encoding='utf-8'))['truth']
        values = [float(truth[name]) for name in BACKLASH if truth[name] is not None]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f'{summary}: is not the summary of a run') from None
    if len(values) == len(BACKLASH):
        for name, value in zip(BACKLASH, values, strict=True):
            run.rows[:, COLUMNS.index(f'true_{name}')] = value
    return run


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `report`."""
    return run_tool('report', lambda: _report(args))


def _report(args: Sequence[str] | None) -> None:
    parser = OptionParser('report', description=__doc__)
    parser.add_argument('path', type=Path, help='a bag, a folder of results, or samples.csv')
    parser.add_argument(
        '--config', type=Path, metavar='FILE',
        help='parameters of the run (default: parameters.yaml beside it)',
    )
    add_out_option(parser)
    add_span_options(parser)
    parser.add_argument('--axis', default='', metavar='NAME',
                        help='of a bag with several: the one to report (default: the first)')
    options = parser.parse_args(args)
    span = span_of(parser, options)
    source = open_source(options.path.resolve(), options.config, span, options.axis)
    if source.run.samples == 0:
        raise InputError(f'{options.path}: holds no sample')
    _tell_damage(source)
    out = result_directory(options.out)
    _write(source, out)
    print(out / PAGE)
