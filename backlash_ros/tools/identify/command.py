"""`identify`: one command from a record, or from an actuator, to a checked parameter file."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from backlash_ros.core.parameters.parameter import Value
from backlash_ros.options import FAILED, OptionParser, positive
from backlash_ros.tools.cli import (
    Span,
    add_out_option,
    add_span_options,
    run_tool,
    span_of,
)
from backlash_ros.tools.identify.names import INTEGRATORS
from backlash_ros.tools.records.columns import parse_columns

if TYPE_CHECKING:
    from backlash_ros.core.records.record import Record

EXECUTABLE = 'identify'


def make_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = OptionParser(
        EXECUTABLE, description=__doc__,
        epilog='Exit codes: 0 the backlash is known, 1 it is not, 2 bad input.',
    )
    parser.add_argument('record', type=Path, nargs='?', metavar='RECORD',
                        help='a bag, a folder of results, or a table (CSV and the like, Parquet) '
                             'with the time, the command v and the output y')
    parser.add_argument('--columns', type=parse_columns, default={}, metavar='t=…,v=…,y=…',
                        help='which columns of the table, or signals of the bag, these are '
                             '(default: told by their names)')
    parser.add_argument('--period', type=positive, metavar='S',
                        help='time from sample to sample [s] (default: told by the stamps)')
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='parameter file that the result goes on from: limits, topics, axes')
    parser.add_argument('--axis', default='', metavar='NAME',
                        help='of several: the one that is meant')
    parser.add_argument('--order', type=_range_to(6, 0), default=(0, 1, 2, 3, 4),
                        metavar='N[-N]', help='numbers of poles that are compared (default: 0-4)')
    parser.add_argument('--delay', type=_range_to(40, 0), default=(), metavar='N[-N]',
                        help='delays that are compared [samples] (default: 0-3, and those up to '
                             '40 if they fit better)')
    parser.add_argument('--integrator', choices=sorted(INTEGRATORS), default='auto',
                        help='whether G has a pole at 1 (default: auto)')
    parser.add_argument('--slope', type=positive, default=1.0, metavar='M',
                        help='m, a gear ratio for instance; it cannot be told from the gain of G '
                             '(default: 1)')
    parser.add_argument('--held-out', type=_share, default=1.0 / 3.0, metavar='SHARE',
                        help='share at the end of the record on which structures are compared '
                             '(default: 0.33)')
    add_span_options(parser)
    add_out_option(parser)
    drive = parser.add_argument_group('with --drive')
    drive.add_argument('--drive', action='store_true',
                       help='move the actuator within control.min, control.max and '
                            'control.rate_max of --config, record, bring it to rest, identify')
    drive.add_argument('--duration', type=positive, metavar='S', default=20.0,
                       help='longest motion [s] (default: 20)')
    drive.add_argument('--precision', type=_percent, default=0.0, metavar='P%',
                       help='end the motion as soon as gap and G are known to this (default: 0, '
                            'the whole duration)')
    drive.add_argument('--amplitude', type=positive, metavar='V', help='keep v within ±V as well')
    drive.add_argument('--rate', type=positive, metavar='V_PER_S',
                       help='keep v slower than this as well')
    drive.add_argument('--output-range', type=float, nargs=2, metavar=('LOW', 'HIGH'),
                       help='end the motion when y leaves this range')
    drive.add_argument('--wait', type=positive, default=10.0, metavar='S',
                       help='how long to wait for a driver (default: 10)')
    drive.add_argument('--rest', type=positive, default=30.0, metavar='S',
                       help='longest way to rest at the end (default: 30)')
    return parser


def _range_to(most: int, least: int) -> Callable[[str], tuple[int, ...]]:
    def parse(text: str) -> tuple[int, ...]:
        first, dash, last = text.partition('-')
        try:
            low = int(first)
            high = int(last) if dash else low
        except ValueError:
            raise argparse.ArgumentTypeError(f'{text!r} must be like {least} or {least}-4') \
                from None
        if not least <= low <= high <= most:
            raise argparse.ArgumentTypeError(
                f'{text} must lie within {least}-{most}, the smaller number first'
            )
        return tuple(range(low, high + 1))
    return parse


def _percent(text: str) -> float:
    number = float(text.removesuffix('%')) / (100.0 if text.endswith('%') else 1.0)
    if not 0.0 <= number < 1.0:
        raise argparse.ArgumentTypeError(f'{text} must be like 1% or 0.01')
    return number


def _share(text: str) -> float:
    number = float(text)
    if not 0.1 <= number <= 0.6:
        raise argparse.ArgumentTypeError(f'{text} must lie within 0.1 and 0.6')
    return number


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `identify`."""
    # The matrices are small: more threads of BLAS would cost more than they bring.
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    outcome: list[bool] = []
    code = run_tool(EXECUTABLE, lambda: outcome.append(_identify(args)))
    return FAILED if outcome == [False] else code


def _identify(args: Sequence[str] | None) -> bool:
    """Do what the options say; returns whether the backlash is known."""
    parser = make_parser()
    arguments = list(sys.argv[1:] if args is None else args)
    # Names of topics are changed as for every node.
    of_ros = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    options = parser.parse_args(arguments[:of_ros])
    if options.drive == (options.record is not None):
        parser.error('give a RECORD, or --drive')
    if arguments[of_ros:] and not options.drive:
        parser.error('--ros-args are for --drive')
    span = span_of(parser, options)
    given = given_values(options.config, options.axis)
    record = _recorded(options, span, given, arguments[of_ros:])
    from backlash_ros.tools.identify.outcome import identified, write_outcome
    found = identified(record, options)
    return write_outcome(found, record, given, options)


def _recorded(
    options: argparse.Namespace, span: Span, given: Mapping[str, Value],
    ros_arguments: Sequence[str],
) -> Record:
    # numpy, scipy and matplotlib are loaded once the options are known to be right.
    if options.drive:
        from backlash_ros.tools.identify.drive import drive
        if options.axis:
            ros_arguments = [*(ros_arguments or ['--ros-args']), '-r', f'__ns:=/{options.axis}']
        return drive(options, given, ros_arguments)
    from backlash_ros.tools.records.reading import read_record
    period = options.period or given.get('sample_period')
    return read_record(
        options.record, period if isinstance(period, float) else None, span, options.axis,
        options.columns,
    )


def given_values(config: Path | None, axis: str) -> Mapping[str, Value]:
    """What the user's file holds for the axis; nothing without a file."""
    if config is None:
        return {}
    from backlash_ros.tools.config import check_axis, find_config, read_parameter_file
    file = read_parameter_file(find_config(config))
    file.check_axes(file.axes)
    if file.axes:
        check_axis(file, axis, file.axes)
    return file.values(axis)
