"""Groups of processes, and the guardian that ends those of an orchestrator that has died."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from pathlib import Path

PROCESSES = Path('/proc')
# SIGINT lets a node end as by Ctrl-C; a recorder may need a while to close a large bag.
ESCALATION = ((signal.SIGINT, 10.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


def group_exists(group: int) -> bool:
    """Whether a process of this group is left; a zombie is none, for it may never be collected."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    if not PROCESSES.is_dir():
        return True
    # The leader first: only when it has gone all others must be looked through.
    return _lives_in(str(group), group) or any(
        _lives_in(entry.name, group) for entry in PROCESSES.iterdir() if entry.name.isdigit()
    )


def _lives_in(process: str, group: int) -> bool:
    try:
        stat = (PROCESSES / process / 'stat').read_text(encoding='utf-8', errors='replace')
    except OSError:
        return False
    # The name of the program stands in parentheses and may hold anything.
    state, _, its_group = stat.rpartition(')')[2].split()[:3]
    return int(its_group) == group and state not in ('Z', 'X')


def stop_groups(
    alive: Callable[[], Collection[int]], wait: Callable[[], None], hurry: Callable[[], bool],
    farewell_s: float = 0.0,
) -> None:
    """Signal process groups, ever more firmly, until none is alive or all means are used up.

    alive: the groups that are left. wait: passes a moment. hurry: yes skips to SIGKILL.
    farewell_s: how much longer the first signal may take than usual.
    """
    for number, usual in ESCALATION:
        patience = usual + farewell_s * (number == ESCALATION[0][0])
        if hurry() and number != signal.SIGKILL:
            continue
        for group in alive():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(group, number)
        deadline = time.monotonic() + patience
        while alive() and time.monotonic() < deadline:
            if hurry() and number != signal.SIGKILL:
                break
            wait()


def guard(orders: Iterable[str]) -> None:
    """Read `+GROUP STAGE FAREWELL` and `-GROUP` until the end, then stop what stays.

    One stage goes after the other. The end comes when the orchestrator closes the pipe or the
    kernel does it after its death.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    stages: dict[int, int] = {}
    farewells: dict[int, float] = {}
    for order in orders:
        group, *more = order[1:].split()
        if order[0] == '+':
            stages[int(group)], farewells[int(group)] = int(more[0]), float(more[1])
        else:
            stages.pop(int(group), None)
    for now in sorted(set(stages.values())):
        groups = [group for group, stage in stages.items() if stage == now]
        stop_groups(
            partial(_existing, groups), lambda: time.sleep(0.02), lambda: False,
            max(farewells[group] for group in groups),
        )


def _existing(groups: Sequence[int]) -> list[int]:
    return [group for group in groups if group_exists(group)]


if __name__ == '__main__':
    guard(sys.stdin)
