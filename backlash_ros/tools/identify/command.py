"""`identify`: make a checked parameter file from a record of v and y, or by moving an actuator."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path

from backlash_ros.core.parameters import Value
from backlash_ros.options import (
    DONE,
    FAILED,
    OptionParser,
    add_motion_options,
    check_motion_options,
    positive,
)
from backlash_ros.tools.cli import InputError, add_options, run_tool, span_of


def make_parser() -> argparse.ArgumentParser:
    """The parser of the options."""
    parser = OptionParser(
        'identify', description=__doc__,
        epilog='Exit codes: 0 the backlash is known, 1 it is not, 2 bad input.')
    parser.add_argument('record', type=Path, nargs='?', metavar='RECORD',
                        help='a bag, a folder of results, or a table (CSV and the like, Parquet) '
                             'with the time, the command v and the output y')
    parser.add_argument('--period', type=positive, metavar='S',
                        help='time from sample to sample [s] (default: from the stamps)')
    parser.add_argument('--config', type=Path, metavar='FILE',
                        help='parameter file that the result is based on: limits, topics, axes')
    parser.add_argument('--order', type=lambda text: _numbers(text, 6), default=(0, 1, 2, 3, 4),
                        metavar='N[-N]', help='numbers of poles to compare (default: 0-4)')
    parser.add_argument('--delay', type=lambda text: _numbers(text, 40), default=(),
                        metavar='N[-N]',
                        help='delays to compare [samples] (default: 0-3, and later ones, up to 40, '
                             'if they fit better)')
    parser.add_argument('--integrator', choices=('auto', 'no', 'yes'), default='auto',
                        help='whether G has a pole at 1 (default: auto)')
    parser.add_argument('--slope', type=positive, default=1.0, metavar='M',
                        help='m, for instance a gear ratio: it cannot be separated from the gain '
                             'of G (default: 1)')
    add_options(parser, '--columns', '--axis', '--from', '--to', '--out')
    drive = parser.add_argument_group('with --drive')
    drive.add_argument('--drive', action='store_true',
                       help='move the actuator within control.min, control.max and '
                            'control.rate_max of --config, record, bring it to rest, identify')
    drive.add_argument('--precision', type=share, default=0.0, metavar='P%',
                       help='end the motion as soon as gap and G are known this well (default: 0, '
                            'for the whole duration)')
    add_motion_options(drive, 20.0, 'longest motion')
    return parser


def _numbers(text: str, most: int) -> tuple[int, ...]:
    first, _, last = text.partition('-')
    if not (first.isdecimal() and (last or first).isdecimal()
            and int(first) <= int(last or first) <= most):
        raise argparse.ArgumentTypeError(
            f'{text!r} must be a number, or two like 0-{most}, the smaller one first, up to {most}')
    return tuple(range(int(first), int(last or first) + 1))


def share(text: str) -> float:
    """Type of an option like 1% or 0.01; argparse reports a text that is not."""
    number = float(text.removesuffix('%')) / (100.0 if text.endswith('%') else 1.0)
    if not 0.0 <= number < 1.0:
        raise argparse.ArgumentTypeError(f'{text!r} must be like 1% or 0.01')
    return number


def _identify(args: Sequence[str] | None) -> int:
    parser = make_parser()
    arguments = list(sys.argv[1:] if args is None else args)
    # Topics can be remapped, as for every node.
    of_ros = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
    options, ros_arguments = parser.parse_args(arguments[:of_ros]), arguments[of_ros:]
    if options.drive == (options.record is not None):
        parser.error('give a RECORD, or --drive')
    if ros_arguments and not options.drive:
        parser.error('--ros-args are for --drive')
    if options.precision and not options.drive:
        parser.error('--precision needs --drive')
    if options.drive and (options.columns or options.from_s or options.to_s < inf):
        parser.error('--columns, --from and --to are for a RECORD')
    check_motion_options(parser, options)
    span = span_of(options)
    given: Mapping[str, Value] = {}
    # numpy, scipy and matplotlib are loaded only once the options are valid.
    if options.config is not None:
        from backlash_ros.tools.config import read_configuration
        configuration = read_configuration(options.config)
        if configuration.joints:
            raise InputError(f'{configuration.path}: is of several joints: give a file with the '
                             'limits of one alone, and copy into this one what is identified')
        given = configuration.given(options.axis if configuration.axes else '')
    given_period = options.period or given.get('sample_period')
    period = given_period if isinstance(given_period, float) else None
    if options.drive:
        from backlash_ros.tools.identify.drive import drive
        from backlash_ros.tools.runs.files import results_folder
        results_folder(options.out)  # fails before the motion, not after it
        if options.axis:
            ros_arguments = [*(ros_arguments or ['--ros-args']), '-r', f'__ns:=/{options.axis}']
        record = drive(options, given, period, ros_arguments)
    else:
        from backlash_ros.tools.records.reading import read_record
        record = read_record(options.record, period, span, options.axis, options.columns)
    from tqdm import tqdm

    from backlash_ros.tools.identify.outcome import identify_record, write_outcome
    with tqdm(file=sys.stderr, disable=None, leave=False, bar_format='{desc}: {elapsed}') as bar:
        found = identify_record(record, options, bar.set_description_str)
    return DONE if write_outcome(found, record, given, options) else FAILED


main = partial(run_tool, 'identify', _identify)
