"""Who gets the processor first: the loop, then its fits, then whoever only watches.

Linux shares it among sessions first, then among processes by their niceness; see autogroup in
sched(7). Where a kernel or a container does not allow it, a process stays as it is.
"""

import ctypes
import os
import platform
import struct
from contextlib import suppress
from pathlib import Path

# A process that wakes up interrupts one with longer turns, since Linux 6.12; by default they are
# 1.4 ms on two processors, and longer on more. A sample takes less than this [ns].
TURN_NS = 700_000
SCHED_SETATTR = {'x86_64': 314, 'aarch64': 274}  # number of the system call, by machine


def answer_first() -> None:
    """Have this process run as soon as it wakes up. Call it first, as threads inherit it."""
    if os.sched_getscheduler(0) == os.SCHED_OTHER:  # else it has a better class already
        _take_turns(0, TURN_NS)


def compute_beside(pid: int) -> None:
    """Have this process, a worker, run when the one that started it does not need to."""
    # It inherits what the loop has, a real-time class included.
    os.sched_setscheduler(pid, os.SCHED_OTHER, os.sched_param(0))
    niceness = os.getpriority(os.PRIO_PROCESS, 0) + 5
    os.setpriority(os.PRIO_PROCESS, pid, niceness)
    _take_turns(pid, 0)
    with suppress(OSError):  # kernel without autogroup scheduling
        Path(f'/proc/{pid}/autogroup').write_text(str(niceness))


def give_way() -> None:
    """Have this process interrupt none that runs, of whatever session. Call it first."""
    os.nice(10)
    with suppress(OSError):  # some containers do not allow it
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _take_turns(pid: int, turn_ns: int) -> None:
    """Set the length of the turns of a process of the usual class; 0 for the default."""
    if number := SCHED_SETATTR.get(platform.machine()):
        niceness = os.getpriority(os.PRIO_PROCESS, pid)
        # struct sched_attr: size, class, flags, niceness, priority, runtime, deadline, period.
        attributes = struct.pack('=IIQiIQQQ', 48, os.SCHED_OTHER, 0, niceness, 0, turn_ns, 0, 0)
        ctypes.CDLL(None).syscall(number, pid, attributes, 0)
