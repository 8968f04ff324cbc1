"""`compare`: every law and structure on one scenario, as a figure, a table and a document."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from backlash_ros.atomic_file import write_atomically
from backlash_ros.options import OptionParser
from backlash_ros.tools.cli import command_line
from backlash_ros.tools.cli.command_line import number_of_samples
from backlash_ros.tools.compare.comparison import HEADER, compare, row
from backlash_ros.tools.config.configuration import effective_parameters
from backlash_ros.tools.run_files.results import result_directory

DOCUMENT, FIGURE = Path('comparison.md'), Path('images/comparison.png')


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `compare`."""
    return command_line.run_tool('compare', lambda: _compare(args))


def make_parser() -> argparse.ArgumentParser:
    """The options of `compare`."""
    parser = OptionParser('compare', description=__doc__)
    command_line.add_common_options(parser)
    parser.add_argument('--duration', type=float, default=10.0, metavar='SECONDS',
                        help='length of each run (default: 10)')
    return parser


def _compare(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    scenario = effective_parameters(
        options.config, options.settings, options.seed, options.axis
    )
    samples = number_of_samples(scenario, options.duration)
    results = compare(scenario, samples)
    # Drawing libraries take a second to load, which bad input should not cost.
    from backlash_ros.tools.compare.document import comparison_document, draw_comparison
    from backlash_ros.tools.pages.drawing import png
    print(command_line.format_table(HEADER, [row(result) for result in results]))
    out = result_directory(options.out)
    document, figure = out / DOCUMENT, out / FIGURE
    figure.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(figure, png(draw_comparison(results)))
    write_atomically(document, comparison_document(scenario, results, FIGURE.as_posix()))
    print(f'document: {document}')
