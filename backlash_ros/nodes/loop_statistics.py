"""What the controller counts about its loop."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np

REMEMBERED = 1000  # latencies that p50 and p99 are taken of


@dataclass
class LoopStatistics:
    """Counters since the start. latencies [s]: the newest ones, as topics.py defines them."""

    used: int = 0  # outputs that brought a command
    lost: int = 0  # outputs that never arrived
    unsent: int = 0  # of these, the ones that the driver never published
    dropped: int = 0  # messages that held no finite number
    extra: int = 0  # outputs that were repeated, too early, old or of a second driver
    interruptions: int = 0  # times that the driver was silent or began anew
    without_reference: int = 0  # outputs before the first y_m
    limited: int = 0  # commands that met a limit
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _v_low: float = inf
    _v_high: float = -inf
    _looked_at: float = field(default_factory=time.monotonic)
    _used_before: int = 0

    def note(self, v: float, limited: bool, latency: float) -> None:
        """Count a command."""
        self.used += 1
        self.limited += limited
        self.latencies.append(latency)
        self._v_low, self._v_high = min(v, self._v_low), max(v, self._v_high)

    def latency_ms(self, share: float) -> float:
        """Latency that this share of the latest commands stayed below; nan without any."""
        if not self.latencies:
            return nan
        return float(np.percentile(self.latencies, 100.0 * share)) * 1e3

    def since_last_look(self) -> tuple[float, float]:
        """Rate of commands [Hz] and swing of v since the last call."""
        now = time.monotonic()
        passed = max(now - self._looked_at, 1e-9)
        rate, swing = (self.used - self._used_before) / passed, self._v_high - self._v_low
        self._looked_at, self._used_before = now, self.used
        self._v_low, self._v_high = inf, -inf
        return rate, max(swing, 0.0)
