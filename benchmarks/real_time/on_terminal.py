"""Runs a command as if on a terminal that somebody reads: `on_terminal.py COMMAND ...`."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import subprocess
import sys


def main() -> int:
    """Throw away what it shows; returns its exit code. Signals are for the command."""
    terminal, own_end = pty.openpty()
    command = subprocess.Popen(sys.argv[1:], stdin=own_end, stdout=own_end, stderr=own_end)
    os.close(own_end)
    # Both are of one process group, which a supervisor signals as a whole.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: None)
    with contextlib.suppress(OSError):  # nobody writes any more
        while os.read(terminal, 65536):
            pass
    return command.wait()


if __name__ == '__main__':
    sys.exit(main())
