"""Keys of a terminal, read as they are pressed."""

from __future__ import annotations

import os
import re
import select
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

# Arrows and function keys come as sequences of which a part looks like other keys.
SEQUENCE = re.compile(r'\x1b(\[|O)[0-9;]*.?')


@contextmanager
def pressed_keys(stream: TextIO) -> Iterator[Callable[[], str]]:
    """A function that returns what was pressed since its last call; nothing but on a terminal.

    Ctrl-C still is a signal. The terminal is left as it was found.
    """
    if not stream.isatty():
        yield lambda: ''
        return
    descriptor = stream.fileno()
    before = termios.tcgetattr(descriptor)

    def read() -> str:
        if not select.select([descriptor], [], [], 0.0)[0]:
            return ''
        return SEQUENCE.sub('', os.read(descriptor, 100).decode(errors='ignore'))

    try:
        tty.setcbreak(descriptor)
        yield read
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
