"""What the command-line tools share: options, how they end, tables."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.options import BAD_INPUT, DONE, FAILED
from backlash_ros.tools.cli.errors import BrokenOffError, InputError

if TYPE_CHECKING:
    from backlash_ros.tools.run_files.bag_sections import Span

DEFAULT_DURATION_S = 10.0  # of a run
# A duration may miss a whole number of sample periods by rounding alone.
WHOLE_TOLERANCE = 1e-6


def add_common_options(parser: argparse.ArgumentParser) -> None:
    """Add what `bringup` and `simulate` have in common."""
    parser.add_argument(
        '--config', type=Path, metavar='FILE',
        help="ROS 2 parameter file, or the name of a shipped one (default: the paper's example)",
    )
    parser.add_argument(
        '--set', action='append', default=[], metavar='[AXIS/]KEY=VALUE', dest='settings',
        help='change one parameter, of all axes or of one; may be given again',
    )
    parser.add_argument(
        '--axis', default='', metavar='NAME',
        help='take this axis alone from a file with several axes',
    )
    parser.add_argument('--seed', type=int, metavar='N', help='seed of the simulated noise')
    add_out_option(parser)


def add_out_option(parser: argparse.ArgumentParser) -> None:
    """Add --out, for `results.result_directory`."""
    parser.add_argument(
        '--out', type=Path, metavar='DIR',
        help='folder of the results (default: results/<UTC time>, and results/latest points at it)',
    )


def add_span_options(parser: argparse.ArgumentParser) -> None:
    """Add --from and --to, for `span_of`."""
    parser.add_argument('--from', type=float, default=0.0, metavar='S', dest='from_s',
                        help='leave out what was before this time [s]')
    parser.add_argument('--to', type=float, default=inf, metavar='S', dest='to_s',
                        help='leave out what was from this time [s] on')


def span_of(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Span:
    """The part of a record between --from and --to; raises InputError where there is none."""
    if not options.from_s < options.to_s:
        parser.error(f'--from {options.from_s:g} must be < --to {options.to_s:g}')
    # numpy is loaded once the options are known to be right.
    from backlash_ros.tools.run_files.bag_sections import Span
    return Span(options.from_s, options.to_s)


def whole_samples(duration: float, sample_period: float) -> int:
    """Number of samples in duration [s]; raises InputError unless it is a whole one >= 1."""
    if not 0.0 < duration < float('inf'):
        raise InputError(f'--duration={duration!r} must be finite and > 0')
    samples = round(duration / sample_period)
    if samples < 1 or abs(duration / sample_period - samples) > WHOLE_TOLERANCE * samples:
        raise InputError(
            f'--duration={duration!r} must be a whole multiple of sample_period={sample_period!r}'
        )
    return samples


def number_of_samples(parameters: Parameters, duration: float | None) -> int:
    """Length of a run: duration [s] if given, else the parameter samples, else 10 s."""
    if duration is None and parameters.get_int('samples') > 0:
        return parameters.get_int('samples')
    if duration is None:
        duration = DEFAULT_DURATION_S
    return whole_samples(duration, parameters.get_float('sample_period'))


def run_tool(name: str, tool: Callable[[], None]) -> int:
    """Run a tool and return its exit code; whatever stops it becomes one line on stderr.

    Call it from the main thread: a SIGTERM stops the tool as a Ctrl-C does.
    """
    handler = signal.signal(signal.SIGTERM, _interrupt)
    try:
        tool()
    except (ParameterError, InputError) as error:
        return _fail(name, str(error), BAD_INPUT)
    except SystemExit as ended:
        return int(ended.code or DONE)  # the parser of the options has said why
    except KeyboardInterrupt:
        return _fail(name, 'interrupted', FAILED)
    except (BrokenOffError, OSError) as error:
        return _fail(name, str(error), FAILED)
    finally:
        signal.signal(signal.SIGTERM, handler)
    return DONE


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def print_warnings(name: str, parameters: Parameters) -> None:
    """Say on stderr what is allowed but will make the estimate hard."""
    # The options are read before numpy and scipy are loaded.
    from backlash_ros.core.assembly import warnings_of
    for warning in warnings_of(parameters):
        print(f'{name}: warning: {warning}', file=sys.stderr)


def _fail(name: str, message: str, code: int) -> int:
    print(f'{name}: {message}', file=sys.stderr)
    return code


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns aligned: the first to the left, all others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    return '\n'.join(
        '  '.join(
            cell.rjust(width) if i else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    )
