"""What all command-line tools share: options, errors, signals, tables."""

import argparse
import atexit
import signal
import sys
import time
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.options import BAD_INPUT, DONE, FAILED, print_any_text
from backlash_ros.tools import leave
from backlash_ros.tools.records.columns import parse_columns

NOTHING = '–'  # stands in tables for a missing number


class InputError(ValueError):
    """The user's input cannot be used: one line says what, why, and the cure if it is known."""


class BrokenOffError(RuntimeError):
    """A run could not go on, although its input was valid: one line says why."""


class Span(NamedTuple):
    """A part of a run, in seconds from its first sample: from_s <= t < to_s."""

    from_s: float = 0.0
    to_s: float = inf


WHOLE_SPAN = Span()
OPTIONS: dict[str, dict[str, Any]] = {
    '--config': {'type': Path, 'metavar': 'FILE', 'help': 'parameter file, or the name of a '
                 "shipped one (default: that beside a recorded run, or the paper's example)"},
    '--set': {'action': 'append', 'default': [], 'metavar': '[AXIS/]KEY=VALUE', 'dest': 'settings',
              'help': 'change one parameter, of all axes or of one; may be given again'},
    '--sweep': {'action': 'append', 'default': [], 'metavar': 'KEY=v1,v2,...', 'help': 'run every '
                'value of a parameter; given again, every combination'},
    '--columns': {'type': parse_columns, 'default': {}, 'metavar': 't=…,v=…,y=…', 'help': 'which '
                  'columns of a table, or signals of a bag (default: by their names)'},
    '--axis': {'default': '', 'metavar': 'NAME', 'help': 'which one of several axes or joints'},
    '--seed': {'type': int, 'metavar': 'N', 'help': 'seed of the simulated noise'},
    '--duration': {'type': float, 'metavar': 'SECONDS', 'help': 'length of a run (default: the '
                   'parameter samples, or about 10 s)'},
    '--from': {'type': float, 'default': 0.0, 'metavar': 'S', 'dest': 'from_s', 'help': 'leave '
               'out what was before this time [s]'},
    '--to': {'type': float, 'default': inf, 'metavar': 'S', 'dest': 'to_s', 'help': 'leave out '
             'what was from this time on [s]'},
    '--out': {'type': Path, 'metavar': 'DIR', 'help': 'folder of the results (default: results/'
              '<UTC time>, and results/latest points at it)'},
}


def add_options(parser: argparse.ArgumentParser, *names: str) -> argparse.ArgumentParser:
    for name in names:
        parser.add_argument(name, **OPTIONS[name])
    return parser


def span_of(options: argparse.Namespace) -> Span:
    """The part of a run between --from and --to; raises InputError unless --from < --to."""
    if not options.from_s < options.to_s:
        raise InputError(f'--from {options.from_s:g} must be < --to {options.to_s:g}')
    return Span(options.from_s, options.to_s)


def number_of_samples(parameters: Parameters, duration: float | None) -> int:
    """Length of a run: duration [s] if given, else the parameter samples, else about 10 s."""
    period = parameters.sample_period
    if duration is None:
        return parameters.samples or max(round(10.0 / period), 100)
    if not 0.0 < duration < inf:
        raise InputError(f'--duration={duration!r} must be finite and > 0')
    samples = round(duration / period)
    # Rounding may keep the quotient from being a whole number.
    if samples < 1 or abs(duration / period - samples) > 1e-6 * samples:
        raise InputError(f'--duration={duration!r} must be a whole multiple of '
                         f'sample_period={period!r}')
    return samples


def run_tool(
    name: str, tool: Callable[[Sequence[str] | None], int | None],
    args: Sequence[str] | None = None,
) -> int:
    """Run a tool and return its exit code; errors are reported in one line on stderr.

    Call it from the main thread: SIGTERM stops the tool as Ctrl-C does.
    """
    print_any_text()
    if signal.getsignal(signal.SIGINT) is leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The interpreter takes a while to end: another Ctrl-C then would change the exit code.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    try:
        return tool(args) or DONE
    except SystemExit as ended:
        return int(ended.code or DONE)  # the option parser has said why
    except (ParameterError, InputError, BrokenOffError, OSError, KeyboardInterrupt) as error:
        print(f'{name}: {str(error) or "interrupted"}', file=sys.stderr)
        return BAD_INPUT if isinstance(error, (ParameterError, InputError)) else FAILED
    finally:
        signal.signal(signal.SIGTERM, handler)


def print_warnings(name: str, parameters: Parameters) -> None:
    """Print on stderr which parameters are allowed but will make estimation hard."""
    # Imported here, as options are parsed before numpy and scipy are loaded.
    from backlash_ros.core.assembly import warnings_of
    for warning in warnings_of(parameters):
        print(f'{name}: warning: {warning}', file=sys.stderr)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as text, the first column aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    return '\n'.join(
        '  '.join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
        for row in (header, *rows))


def number(value: float | None, digits: int = 4, unit: str = '', scale: float = 1.0) -> str:
    """A number with its unit as text; NOTHING for None and nan."""
    if value is None or value != value:
        return NOTHING
    return f'{scale * value:.{digits}g}{unit and " "}{unit}'


class StopRequests:
    """Counts SIGINT, SIGTERM and SIGHUP while the context lasts, instead of dying of them.

    A second one within 0.2 s does not count, as the same Ctrl-C may arrive twice.
    """

    count, last, _came_at_s = 0, '', -inf

    def __enter__(self) -> 'StopRequests':
        self._before = {
            caught: signal.signal(caught, self._note)
            for caught in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            # Under nohup SIGHUP stays ignored.
            if caught != signal.SIGHUP or signal.getsignal(caught) is not signal.SIG_IGN
        }
        return self

    def __exit__(self, *error: object) -> None:
        for caught, handler in self._before.items():
            signal.signal(caught, handler)

    def _note(self, number: int, _: object) -> None:
        self.count += time.monotonic() > self._came_at_s + 0.2
        self._came_at_s = time.monotonic()
        self.last = signal.Signals(number).name
