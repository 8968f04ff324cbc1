"""What was applied during the last samples, for laws that look back."""

from __future__ import annotations

from collections import deque

from backlash_ros.core.law import Interval


class History:
    """Delay line that pairs what was applied with u reconstructed `lag` samples later.

    The newest interval carried u(k-1), the oldest one kept carried u(k-lag).
    """

    def __init__(self, lag: int) -> None:
        self._line: deque[Interval] = deque(maxlen=lag)

    def push(self, interval: Interval) -> Interval | None:
        """Take in the newest interval; return the one of u(k-lag), None while filling."""
        self._line.append(interval)
        return self._line[0] if len(self._line) == self._line.maxlen else None
