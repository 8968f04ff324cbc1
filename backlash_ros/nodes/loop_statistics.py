"""What the controller counts about its loop."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

REMEMBERED = 1000  # latencies that p50 and p99 are taken of


@dataclass
class LoopStatistics:
    """Counters since the start. latencies [s]: departure of y at the driver to that of v."""

    used: int = 0  # outputs that brought a command
    lost: int = 0  # outputs that never arrived
    dropped: int = 0  # messages that held no finite number
    without_reference: int = 0  # outputs before the first y_m
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def latency_ms(self, share: float) -> float:
        """Latency that this share of the latest commands stayed below; nan without any."""
        if not self.latencies:
            return float('nan')
        ordered = sorted(self.latencies)
        return ordered[min(int(share * len(ordered)), len(ordered) - 1)] * 1e3
