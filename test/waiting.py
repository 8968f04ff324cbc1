"""Waiting on a condition: once, for all tests."""

import time
from collections.abc import Callable

DEADLINE_S = 240.0  # for a machine under load; nothing here takes long
STEP_S = 1.0  # the most that counts of one step: a machine may be suspended meanwhile


def pause() -> None:
    time.sleep(0.02)


def wait_until(
    condition: Callable[[], object], what: str, wait: Callable[[], None] = pause,
) -> None:
    waited, before = 0.0, time.monotonic()
    while not condition():
        if waited >= DEADLINE_S:
            raise TimeoutError(f'not within {DEADLINE_S:g} s: {what}')
        wait()
        now = time.monotonic()
        waited, before = waited + min(now - before, STEP_S), now
