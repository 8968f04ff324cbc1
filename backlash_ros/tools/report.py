"""`report`: write report.html, figures and summary.json from a bag or saved results."""

import argparse
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import RunRecord, control_error
from backlash_ros.options import OptionParser
from backlash_ros.tools import cli, figures
from backlash_ros.tools.cli import NOTHING, number
from backlash_ros.tools.config import config_text
from backlash_ros.tools.figures import png
from backlash_ros.tools.page import Picture, table, write_page
from backlash_ros.tools.records.reading import read_run_or_log
from backlash_ros.tools.runs import files
from backlash_ros.tools.runs import summary as summaries
from backlash_ros.topics import BACKLASH

REPORT_PAGE = 'report.html'
HTML_SYMBOLS = {'m': 'm', 'c_r': 'c<sub>r</sub>', 'c_l': 'c<sub>l</sub>'}


def write_report(run: files.Run, out: Path) -> dict[str, Any]:
    """Write report, figures, samples.csv and summary.json of a run to out; return the summary."""
    summary = summaries.summarise(run.record, run.parameters)
    lost, total = summary['lost_samples'], summary['lost_samples'] + summary['samples']
    if lost > 0.01 * total and not (run.parameters and run.parameters.output_loss):
        run = run._replace(notes=(*run.notes, (
            f'{lost} of {total} samples were lost: was the machine too busy for this sample '
            'period, or the driver or its sensor silent?')))
    run.print_notes('report')
    files.write_run(run.record, out)
    files.write_summary(summary, out / 'summary.json')
    folded = None
    if run.parameters is not None:
        folded = 'Parameters of this run', config_text(run.parameters)
        write_atomically(out / files.CONFIG_FILE, folded[1])
    write_page(
        out / REPORT_PAGE, 'Adaptive backlash inverse control', headline(summary),
        [f'{note}.' for note in run.notes], [_tables(summary)],
        list(_figures(run.record, run.parameters, summary)), folded)
    return summary


def _figures(
    run: RunRecord, parameters: Parameters | None, summary: Mapping[str, Any],
) -> Iterator[Picture]:
    if not run.has_estimates:
        yield Picture('log.png', 'v and y', 'What the log holds. With play, y over v is a loop '
                      'with level stretches where v turns.', png(figures.draw_log(run)))
        return
    start, end = summaries.interesting_parts(run)
    parts = {'Start': start, 'End': end}
    truth, error, innovation = run.has_truth, control_error(run), run.column('innovation')
    laws, notes = summaries.compare_laws(run, parameters) if truth and parameters else ({}, [])
    known = np.isfinite(error).any()
    duration = min(float(run.column('t')[-1]) + run.sample_period, 1e4 * run.sample_period)
    off = summary['tracking_error_rms']
    followed = off is not None and off < 0.5  # of the RMS of the reference
    for wanted, name, heading, caption, draw, *arguments in (
        (truth, 'parameter_errors', 'Parameter errors over time (Figure 4 of the paper)',
         'How far the estimates are from the hidden backlash, and in percent of it. A dot marks '
         'the time from which the error stays within 1 %.',
         figures.draw_parameter_errors, start, summary['settling_time_s']),
        (True, 'estimates', 'Estimates over time', 'What the controller has learned from v and y '
         'alone; a band shows how sure it is where the law knows.', figures.draw_estimates),
        (known, 'control_error', 'Control error of this run',
         'e = u − u<sub>d</sub> (3.4): what the inverse leaves of the backlash.',
         figures.draw_closer, error, '$u - u_d$ [unit of u]', parts),
        (not known and np.isfinite(innovation).any(), 'innovation', 'Innovation',
         'y minus its prediction. White and small: the model explains the plant.',
         figures.draw_closer, innovation, r'$y - \hat{y}$ [unit of y]', parts),
        (laws, 'laws', 'Control error of the laws (Figure 5 of the paper)',
         'This run beside the other laws, simulated with the same parameters, over the first '
         f'{duration:.6g} s.' + ''.join(f' Without a curve: {escape(note)}.' for note in notes),
         lambda _: figures.draw_error_curves(laws)),
        (True, 'hysteresis', 'Backlash: the v–u loop',
         'u follows the right line going up, the left line going down, and is held between them. '
         'Where a dashed line lies on the wide one, the estimate is right.' if truth else
         'The loop as the last estimates see it: u itself was not measured.',
         figures.draw_hysteresis, end),
        (True, 'output', 'Reference and output', 'y follows y<sub>m</sub>.' if followed else
         'Each on its own scale: y does not follow y<sub>m</sub>, nor does the structure '
         'u<sub>d</sub> = y<sub>m</sub> + f v aim at that.',
         figures.draw_output, end, summaries.reference_delay(parameters), followed),
        (True, 'input', 'Desired input and control', 'v jumps by the width of the gap whenever '
         'u<sub>d</sub> turns.', figures.draw_input, parts),
    ):
        if wanted:
            yield Picture(f'{name}.png', heading, caption, png(draw(run, *arguments)))


def headline(summary: Mapping[str, Any]) -> str:
    if summary['final']['m'] is None or not np.isfinite(summary['final']['m']):
        return 'A log of v and y, which no controller has estimated anything from: try identify.'
    times, who = summary['settling_time_s'], f'The law <b>{summary["estimator"] or "–"}</b>'
    if summary['truth']['m'] is None:
        return f'{who} estimated the backlash; no truth was recorded to compare with.'
    if late := [HTML_SYMBOLS[name] for name, time in times.items() if time is None]:
        return f'{who} did not bring {" and ".join(late)} to within 1 % of the truth.'
    return (f'{who} has had m, c<sub>r</sub> and c<sub>l</sub> within 1 % of the truth since '
            f'<b>{max(times.values()):.4g} s</b>.')


def _tables(summary: Mapping[str, Any]) -> str:
    rows = [
        (symbol, *summaries.estimate_cells(summary, name), 'of u/v' if name == 'm' else 'of v')
        for name, symbol in HTML_SYMBOLS.items()]
    rows.append(('f', number(summary['final']['f'], 6), *[NOTHING] * 4, 'of u/v'))
    latency = summary['loop_latency_ms'] or {'p50': None, 'p99': None}
    duration = (summary['samples'] + summary['lost_samples']) * summary['sample_period']
    first = summary['began_with']
    began = ', '.join(f'{name} {number(first[name], 6)}' for name in BACKLASH)
    return table(('', *summaries.ESTIMATE_HEADER, 'unit'), rows) + table((), [
        ('samples', f'{summary["samples"]} in {duration:.6g} s'),
        ('lost samples', str(summary['lost_samples'])),
        ('sample period', f'{summary["sample_period"]:.6g} s'),
        ('structure', escape(summary['structure'] or NOTHING)),
        ('began with', f'{began}: {escape(first["from"])}' if first['from'] else began),
        ('control error RMS, last second', number(summary['control_error_rms'], 4, '[unit of u]')),
        ('tracking error RMS, last half',
         number(summary['tracking_error_rms'], 3, '% of y<sub>m</sub>', 100.0)
         + (', which is not its aim' if summary['structure'] == 'proportional' else '')),
        *((f'latency y → v, {name}', number(value, 3, 'ms')) for name, value in latency.items()),
        ('state at the end', escape(summary['final_status'] or NOTHING)),
        ('noise on y, learned / nominal', number(summary['noise_ratio'], 3)),
        ('unexplained motion of u',
         number(summary['unexplained'], 3, '% of m times the gap', 100.0)),
        ('samples in state tracking',
         number((summary['status_share'] or {}).get('tracking'), 3, '%', 100.0)),
    ])


def make_parser() -> argparse.ArgumentParser:
    parser = OptionParser('report', description=__doc__)
    parser.add_argument('path', type=Path, help='a bag or its .mcap file, a folder of results, '
                        'samples.csv, or a log as identify reads it')
    return cli.add_options(parser, '--config', '--columns', '--axis', '--from', '--to', '--out')


def _report(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    path = Path(os.path.realpath(options.path))
    run = read_run_or_log(
        path, options.config, cli.span_of(options), options.axis, options.columns)
    out = files.result_directory(options.out)
    write_report(run, out)
    print(out / REPORT_PAGE)


main = partial(cli.run_tool, 'report', _report)

if __name__ == '__main__':
    sys.exit(main())
