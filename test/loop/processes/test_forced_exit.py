"""Processes that do not end by themselves."""

import os
import signal
import subprocess
import sys

from waiting import DEADLINE_S

from backlash_ros.tools.cli import StopRequests

# Calls of a PyDLL keep the interpreter locked, as Fast DDS does when it hangs.
LEAVE = """
import ctypes, sys, time
from backlash_ros.nodes.runtime.process import exit_at_the_latest
with exit_at_the_latest(0.5, 9):
    pass
time.sleep(0.7)
print('all that was to be said')
with exit_at_the_latest(0.5, 3):
    ctypes.PyDLL(None).pause()
"""


def test_a_process_ends_though_the_interpreter_is_locked() -> None:
    done = subprocess.run(
        (sys.executable, '-c', LEAVE), timeout=DEADLINE_S,
        capture_output=True, text=True, check=False,
    )
    assert (done.returncode, done.stdout) == (3, 'all that was to be said\n'), done.stderr


def test_a_signal_while_bringup_is_loaded_ends_it_in_one_line() -> None:
    program = (
        'import os, signal, sys; sys.argv = ["bringup"]; import backlash_ros.tools.bringup;'
        'os.kill(os.getpid(), signal.SIGINT)'
    )
    done = subprocess.run((sys.executable, '-c', program), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, 'bringup: interrupted\n')


def test_a_ctrl_c_that_comes_twice_at_once_counts_once() -> None:
    with StopRequests() as requests:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
        assert (requests.count, requests.last) == (1, 'SIGINT')
