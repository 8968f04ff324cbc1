"""The noise of a signal, from the signal alone."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque


class NoiseLevel:
    """Standard deviation of the white noise in a signal that moves slowly, or in jumps.

    The noise is what the sixth differences show: motion, even with 30 samples per period, leaves
    1e-4 of its amplitude there. They are sqrt(924) times the noise; the median of the size of a
    normal variable is 0.6745 of its deviation.
    """

    def __init__(self) -> None:
        self._signal: deque[float] = deque(maxlen=7)
        self._sizes: deque[float] = deque(maxlen=301)
        self._sorted: list[float] = []

    @property
    def std(self) -> float:
        """0 until enough has been seen."""
        count = len(self._sorted)
        return 1.0 / (924.0**0.5 * 0.6745) * self._sorted[count // 2] if count >= 15 else 0.0

    def take(self, value: float) -> None:
        """Take in the next sample."""
        self._signal.append(value)
        if len(self._signal) < 7:
            return
        a, b, c, d, e, f, g = self._signal
        size = abs(a - 6.0 * b + 15.0 * c - 20.0 * d + 15.0 * e - 6.0 * f + g)
        if len(self._sizes) == self._sizes.maxlen:
            del self._sorted[bisect_left(self._sorted, self._sizes[0])]
        self._sizes.append(size)
        insort(self._sorted, size)
