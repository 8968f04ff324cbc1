"""What all command lines share: exit codes, errors in one line, options, files, one thread."""

import argparse
import os
import sys
from io import TextIOWrapper
from math import inf
from pathlib import Path
from typing import NoReturn

DONE, FAILED, BAD_INPUT = 0, 1, 2  # exit codes
DEFAULT_CONFIG = 'paper_example.yaml'


def use_one_thread() -> None:
    """Keep linear algebra to one thread, unless the user asks for more; call before numpy loads."""
    # Matrices are tiny: more threads make a fit slower, and take processors from other processes.
    names = 'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'
    os.environ.update({**dict.fromkeys(names, '1'), **os.environ})


def print_any_text() -> None:
    """Have stdout replace what its encoding lacks, as on terminals without ±."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors='replace')


class OptionParser(argparse.ArgumentParser):
    """A parser that ends the process with a single line if an option is wrong."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f'{self.prog}: {message} (--help lists the options)\n')


def positive(text: str) -> float:
    """Type of an option that is a number; argparse reports one that is not finite and > 0."""
    number = float(text)
    if not 0.0 < number < inf:
        raise argparse.ArgumentTypeError(f'{text} must be finite and > 0')
    return number


def port(text: str) -> int:
    """Type of an option that is a TCP port; argparse reports a number that is not one."""
    number = int(text)
    if not 0 <= number <= 65535:
        raise argparse.ArgumentTypeError(f'{text} must be from 0 (a free one) to 65535')
    return number


def add_motion_options(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup, duration_s: float, what: str,
) -> None:
    """Add the options of a motion. what: the meaning of --duration, whose default is duration_s."""
    for name, default, unit, text in (
        ('duration', duration_s, 'SECONDS', f'{what} (default: {duration_s:g})'),
        ('wait', 10.0, 'SECONDS', 'how long to wait for a driver (default: 10)'),
        ('rest', 30.0, 'SECONDS', 'drive: longest time to come to rest at the end, after which v '
         'is held (default: 30); a signal in that time holds v at once'),
        ('amplitude', None, 'V', 'drive: keep v within ±V as well'),
        ('rate', None, 'V_PER_S', 'drive: keep v slower than this as well'),
    ):
        parser.add_argument(f'--{name}', type=positive, default=default, metavar=unit, help=text)
    parser.add_argument('--output-range', type=float, nargs=2, metavar=('LOW', 'HIGH'),
                        help='drive: stop when y leaves this range')


def check_motion_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """End the process if options of a motion do nothing without --drive, or are not in order."""
    for name in ('amplitude', 'rate', 'output_range'):
        if getattr(options, name) is not None and not options.drive:
            parser.error(f'--{name.replace("_", "-")} needs --drive')
    if options.output_range and not options.output_range[0] < options.output_range[1]:
        parser.error('--output-range LOW HIGH: {} must be < {}'.format(*options.output_range))


def find_config(config: Path | None) -> Path:
    """Path of a configuration file, as given or among the shipped ones; the paper's if None."""
    if config is not None and (config.exists() or config.parent != Path()):
        return config
    given = config or Path(DEFAULT_CONFIG)
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    # The source tree first: its configuration was written for the code that runs.
    folders = [Path(__file__).resolve().parents[1],
               *(Path(prefix) / 'share' / 'backlash_ros' for prefix in filter(None, prefixes))]
    files = (folder / 'config' / given.name for folder in folders)
    return next(filter(Path.exists, files), given)
