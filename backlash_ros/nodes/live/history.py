"""What the page draws: points of the last seconds, in portions that any reader can follow."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Mapping
from math import isfinite

V, U = 'v', 'u_hat'
LOOP = 'loop'

Curves = dict[str, list[float | None]]


def rounded(value: float) -> float | None:
    """A number for JSON, which has no nan: None."""
    return float(f'{value:.7g}') if isfinite(value) else None


class CurvePoints:
    """Sorts the messages of one controller into points.

    start_ns: the time that counts as 0.
    """

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._v: deque[tuple[int, float]] = deque(maxlen=100)  # of which u has not come

    def take(self, messages: Iterable[tuple[str, int, float]]) -> Curves:
        """By label t [s] and value in turns, and v and u of points of their loop in turns.

        messages: label, time of arrival [ns], value.
        """
        curves: Curves = {}
        reconstructed: list[tuple[int, float]] = []
        for label, at_ns, value in messages:
            t = round(1e-9 * (at_ns - self._start_ns), 3)
            curves.setdefault(label, []).extend((t, rounded(value)))
            if label == V:
                self._v.append((at_ns, value))
            elif label == U:
                reconstructed.append((at_ns, value))
        for at_ns, u in reconstructed:
            # u is sent with the v that it came from, after it: see watch_publisher.py.
            v = None
            while self._v and self._v[0][0] <= at_ns:
                _, v = self._v.popleft()
            if v is not None:
                curves.setdefault(LOOP, []).extend((rounded(v), rounded(u)))
        return curves


class History:
    """The newest portions as JSON, numbered from 0; whoever is too slow misses the oldest.

    portions: how many are kept.
    """

    def __init__(self, portions: int) -> None:
        self._kept: deque[str] = deque(maxlen=portions)
        self.end = 0  # number of the next portion

    def add(self, curves: Mapping[str, Curves]) -> None:
        """Append a portion. curves: by controller."""
        self._kept.append(json.dumps(curves, separators=(',', ':'), allow_nan=False))
        self.end += 1

    def since(self, number: int) -> list[str]:
        """What is kept of the portions from this number on."""
        missed = min(self.end - number, len(self._kept))
        return list(self._kept)[len(self._kept) - missed:]
