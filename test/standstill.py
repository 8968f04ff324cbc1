"""Whether the machine runs at all: what a test with processes needs, and cannot bring about.

A virtual machine may be held back by its host for a second at once, whatever runs on it. A loop of
5 ms does not exist there, and a test of it tells of the host, not of the package.
"""

from __future__ import annotations

import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

import pytest

TICK_S = 0.01
STALL_S = 0.1  # two busy workers with their processes delay a thread that wakes by far less
TOLERATED = 0.25  # share of the time that stalls may take
LOOK_BACK_S = 5.0  # before a test, and at least for one that has failed
KEPT = 10_000  # stalls: the last quarter of an hour, were there nothing else
SUITE_S = 3300.0  # for `make test` as a whole: nine times what it takes where the machine runs
BEGAN = 'MAKE_TEST_BEGAN'  # environment: when `make test` did, by time.time()
OVERDUE = f'NOT RUN: the machine stands still, and {SUITE_S / 60.0:.0f} min of make test are over'


class Standstill:
    """Hears its own timer tick, and keeps when it did not: (begin, end) of each stall [s]."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since = self._heard = clock()
        self._stalls: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def start(self) -> None:
        """Listen from now on, until the process ends."""
        threading.Thread(target=self._listen, name='standstill', daemon=True).start()

    def _listen(self) -> None:
        while True:
            time.sleep(TICK_S)
            self.tick()

    def tick(self) -> None:
        """Take note of the time that has passed since the last tick."""
        now = self._clock()
        if now - self._heard > STALL_S:
            self._stalls.append((self._heard, now))
        self._heard = now

    def share(self, seconds: float) -> float:
        """Share of the last seconds that stalls took, 0 to 1."""
        now = self._clock()
        begin = max(now - seconds, self._since)
        if now <= begin:
            return 0.0
        stalls = list(self._stalls)  # the thread may add to them meanwhile
        return sum(max(0.0, end - max(start, begin)) for start, end in stalls) / (now - begin)

    def reason(self, seconds: float) -> str | None:
        """Why a test with processes says nothing about the last seconds, or None."""
        share = self.share(seconds)
        if share <= TOLERATED:
            return None
        return f'the machine stood still for {share:.0%} of {seconds:.0f} s: nothing is timely here'


def is_overdue(environment: Mapping[str, str], now: float) -> bool:
    """Whether `make test` has taken more than SUITE_S; now: as of time.time()."""
    return now - float(environment.get(BEGAN, now)) > SUITE_S


def ran_out_of_time(error: BaseException) -> bool:
    """Whether a test failed for nothing but the time that it took."""
    return isinstance(error, (TimeoutError, subprocess.TimeoutExpired)) or (
        isinstance(error, pytest.fail.Exception) and 'from pytest-timeout' in str(error)
    )


def excuse(report: pytest.TestReport, reason: str) -> None:
    """Turn the report of a failure into that of a test that was skipped."""
    path, line, _ = report.location
    report.outcome = 'skipped'
    report.longrepr = path, line or 0, f'Skipped: {reason}'
