"""What every command line has in common: exit codes, errors in one line, positive numbers."""

from __future__ import annotations

import argparse
from math import inf
from typing import Any, NoReturn

DONE, FAILED, BAD_INPUT = 0, 1, 2  # exit codes
LARGEST_PORT = 65535  # of TCP


class OptionParser(argparse.ArgumentParser):
    """Ends the process with one line where an option is wrong, like any other bad input.

    hint: what is said after the error.
    """

    def __init__(self, prog: str, hint: str = ' (--help lists the options)', **others: Any) -> None:
        super().__init__(prog, **others)
        self._hint = hint

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end the process."""
        self.exit(BAD_INPUT, f'{self.prog}: {message}{self._hint}\n')


def positive(text: str) -> float:
    """An option that is a number; argparse reports what is not finite and > 0."""
    number = float(text)
    if not 0.0 < number < inf:
        raise argparse.ArgumentTypeError(f'{text} must be finite and > 0')
    return number
