"""An end for processes that the middleware does not let go.

Fast DDS may hang for good while it takes a participant down, if others leave at the same time
(DomainParticipant::set_listener spins, seen with 2.14.5: of five participants that leave together
in one of some 600 exits, with the profile for loopback in one of some 2,800). It does so with the
interpreter locked: no thread of Python and no handler of a signal would ever run. All work is done
by then, so a timer of the C library ends the process instead. faulthandler.dump_traceback_later
would end it too, but with exit code 1, which is that of a failure.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

SIGEV_THREAD = 2  # <signal.h>: the timer calls a function, in a thread of its own


class _SignalEvent(ctypes.Structure):
    """struct sigevent of Linux; value is handed to function."""

    _fields_ = (
        ('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('notify', ctypes.c_int),
        ('function', ctypes.c_void_p), ('attributes', ctypes.c_void_p),
        ('reserved', ctypes.c_char * 32),
    )


class _TimerSpec(ctypes.Structure):
    """struct itimerspec: period and delay as seconds and nanoseconds."""

    _fields_ = tuple(
        (name, ctypes.c_long) for name in ('period_s', 'period_ns', 'delay_s', 'delay_ns')
    )


@contextmanager
def exit_at_the_latest(within_s: float, code: int) -> Iterator[None]:
    """End the process with this exit code where the block takes longer than within_s [s]."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # nobody may be reading any more
            stream.flush()
    if sys.platform != 'linux':
        yield
        return
    c = ctypes.CDLL(None)
    event = _SignalEvent(
        value=code, notify=SIGEV_THREAD, function=ctypes.cast(c._exit, ctypes.c_void_p).value
    )
    timer = ctypes.c_void_p()
    if c.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        yield  # out of timers: without a last resort, as on any other system
        return
    seconds, fraction = divmod(within_s, 1.0)
    c.timer_settime(
        timer, 0, ctypes.byref(_TimerSpec(0, 0, int(seconds), int(fraction * 1e9))), None
    )
    try:
        yield
    finally:
        c.timer_delete(timer)
