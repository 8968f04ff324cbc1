"""Motion of v made for identification: several speeds, amplitudes and rests, in both directions.

A lag shows as a gap that grows with the speed: with one speed only, they could not be told apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count as counted

GOLDEN, SILVER, BRONZE = 0.6180339887, 0.4142135624, 0.3027756377  # spread evenly, never repeat
WIDE = 2  # every so many strokes go to the ends of the range: the gap may be nearly as wide
STROKES = 24  # strokes across the range in the whole motion, at the largest speed of it
SLOWEST = 0.15  # of the largest speed
RESTS = (0.0, 0.1, 0.35)  # times the duration of a stroke at the largest speed


def strokes(low: float, high: float, fastest: float, period: float) -> Iterator[float]:
    """v(k), one per sample, without end. fastest: [v/s], period: of a sample [s]."""
    v = yield_start = 0.5 * (low + high)
    yield yield_start
    up = True
    for k in counted():
        wide = k % WIDE == 0
        part = 1.0 if wide else 0.35 + 0.55 * (k * GOLDEN % 1.0)
        target = v + part * ((high - v) if up else (low - v))
        speed = fastest * SLOWEST ** ((0.13 + k * SILVER) % 1.0)
        move = speed * period
        while v != target:
            v = min(v + move, target) if up else max(v - move, target)
            yield v
        rest = RESTS[int(3.0 * ((k * BRONZE) % 1.0))] * (high - low) / fastest
        for _ in range(round(rest / period)):
            yield v
        up = not up
