"""The options of check_driver, and the parameters that a controller would have."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from math import inf
from pathlib import Path

import yaml

from backlash_ros.options import OptionParser, positive

EXECUTABLE = 'check_driver'
CONTROLLER_SECTIONS = ('/**/controller', 'controller', '/controller')


def parse_options(plain: Sequence[str], description: str | None = None) -> argparse.Namespace:
    """Options besides those of ROS. description: for --help."""
    parser = OptionParser(
        EXECUTABLE, description=description,
        epilog='Exit codes: 0 all fits, 1 something does not, 2 bad input.',
    )
    parser.add_argument('--config', metavar='FILE', help='ROS 2 parameter file of the controller, '
                        'or the name of a shipped one')
    parser.add_argument('--duration', type=positive, default=10.0, metavar='SECONDS',
                        help='how long to listen (default: 10)')
    parser.add_argument('--wait', type=positive, default=10.0, metavar='SECONDS',
                        help='how long to wait for a driver (default: 10)')
    parser.add_argument('--drive', action='store_true',
                        help='move v, to and fro within control.min, control.max and '
                             'control.rate_max, to rest at the end')
    parser.add_argument('--amplitude', type=positive, metavar='V',
                        help='drive: keep v within ±V as well')
    parser.add_argument('--rate', type=positive, metavar='V_PER_S',
                        help='drive: keep v slower than this as well')
    parser.add_argument('--rest', type=positive, default=30.0, metavar='SECONDS',
                        help='drive: longest way to rest at the end, after which v is held '
                             '(default: 30); a signal on that way holds v at once')
    parser.add_argument('--output-range', type=float, nargs=2, default=(-inf, inf),
                        metavar=('LOW', 'HIGH'), help='drive: stop when y leaves this range')
    parser.add_argument('--save', type=Path, metavar='FILE', help='write t,v,y as CSV')
    options = parser.parse_args(plain)
    for name in ('amplitude', 'rate'):
        if getattr(options, name) is not None and not options.drive:
            parser.error(f'--{name} says how to drive: give --drive as well')
    return options


def parameter_files(config: str, folder: Path) -> list[str]:
    """The file, and in folder one more with what it holds for the controller alone, if anything."""
    try:
        document = yaml.safe_load(Path(config).read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return [config]  # rcl says what is wrong with it
    files = [config]
    for section in CONTROLLER_SECTIONS:
        if isinstance(document, dict) and section in document:
            path = folder / f'{len(files)}.yaml'
            path.write_text(yaml.safe_dump({'/**': document[section]}), encoding='utf-8')
            files.append(str(path))
    return files
