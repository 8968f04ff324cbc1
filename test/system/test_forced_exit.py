"""Processes that do not end by themselves."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Calls of a PyDLL keep the interpreter locked, as Fast DDS does when it hangs.
LEAVE = """
import ctypes, sys, time
from backlash_ros.nodes.runtime.forced_exit import exit_at_the_latest
with exit_at_the_latest(0.1, 9):
    pass
time.sleep(0.3)
print('all that was to be said')
with exit_at_the_latest({within}, {code}):
    ctypes.PyDLL(None).pause()
"""


@pytest.mark.parametrize(('within', 'code'), [(0.4, 0), (1.2, 3)])
def test_process_ends_in_time_though_the_interpreter_is_locked(within: float, code: int) -> None:
    done = subprocess.run(
        (sys.executable, '-c', LEAVE.format(within=within, code=code)), timeout=20.0,
        capture_output=True, text=True, check=False,
    )
    assert (done.returncode, done.stdout) == (code, 'all that was to be said\n'), done.stderr
