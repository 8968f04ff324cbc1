"""Waiting on a condition: once, for all tests."""

import time
from collections.abc import Callable

DEADLINE_S = 60.0  # for a machine under load; nothing here takes long


def pause() -> None:
    time.sleep(0.02)


def wait_until(
    condition: Callable[[], object], what: str, wait: Callable[[], None] = pause,
) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() >= deadline:
            raise TimeoutError(f'not within {DEADLINE_S:g} s: {what}')
        wait()
