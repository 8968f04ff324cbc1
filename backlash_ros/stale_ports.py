"""Ports in shared memory that a killed process has left half made.

Fast DDS makes a file of shared memory for every port, and the first word of the file says when it
is complete. Whoever opens a port waits for that word, for good where its maker was killed in
between (seen with 2.14.5: the node hangs before it can say anything, in every later run that meets
the same port). Nobody can be using such a file, so it may go.
"""

from __future__ import annotations

import fcntl
import os
import re
import struct
import time
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path('/dev/shm')  # Linux; elsewhere there is no such folder
PORT = re.compile(r'fastrtps_port\d+')
WORD = struct.Struct('=I')
UNTOUCHED, BEING_MADE = 0, 1  # of Boost.Interprocess, which makes the file
MAKING_TAKES_S = 2.0  # microseconds in fact


def remove_stale_ports(folder: Path = SHARED_MEMORY) -> list[str]:
    """Remove the ports that were never completed; return what was found, for the log."""
    found = []
    for path in sorted(folder.glob('fastrtps_port*')):
        # A file that has gone was removed by somebody else; those of other users may be closed.
        with suppress(FileNotFoundError, PermissionError):
            if PORT.fullmatch(path.name) and (line := _look_after(path)):
                found.append(line)
    return found


def _look_after(path: Path) -> str:
    """What was done about a port, empty if nothing is wrong with it."""
    with path.open('rb') as port:
        there = os.fstat(port.fileno())
        word = port.read(WORD.size)
        complete = len(word) == WORD.size and WORD.unpack(word)[0] not in (UNTOUCHED, BEING_MADE)
        if complete or time.time() - there.st_mtime < MAKING_TAKES_S:
            return ''
        # Nodes start together: a port that another one has made anew since must not be taken.
        fcntl.flock(port, fcntl.LOCK_EX)
        if path.stat().st_ino != there.st_ino:
            return ''
        try:
            path.unlink()
        except PermissionError as error:
            return (f'{path}: a killed process has left it half made, nodes may hang until it is '
                    f'removed: {error.strerror}')
        return f'{path}: removed, a killed process had left it half made'
