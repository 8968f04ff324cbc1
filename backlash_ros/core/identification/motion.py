"""Motion of v made for identification: several speeds, amplitudes and rests, in both directions.

A lag shows as a gap that grows with the speed: with one speed only, they could not be told apart.
Strokes at the speed limit, with rests between, show what is fast in G.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count


def strokes(
    low: float, high: float, rate: float, period: float, duration: float, v: float,
) -> Iterator[float]:
    """v(k), one per sample, without end, beginning at v.

    low, high, rate: limits of v and of its speed [v/s]. period: of a sample [s]. duration: in which
    the record, some 24 strokes across the range, is to be complete [s].
    """
    golden, silver, bronze = 0.6180339887, 0.4142135624, 0.3027756377  # spread evenly, never repeat
    ordinary = min(rate, 24.0 * (high - low) / duration)
    up = v <= 0.5 * (low + high)
    for k in count():
        # Two strokes from end to end, for a gap may be nearly as wide, then two short ones.
        part = 1.0 if k % 4 < 2 else 0.35 + 0.55 * (k * golden % 1.0)
        target = v + part * ((high - v) if up else (low - v))
        target = min(max(target, low), high)  # whatever rounding does
        # Every third is as fast as the actuator may move.
        move = period * (rate if k % 3 == 2 else ordinary * 0.15 ** ((0.13 + k * silver) % 1.0))
        while v != target:
            v = min(v + move, target) if v < target else max(v - move, target)
            yield v
        rest = (0.0, 0.1, 0.35)[int(3 * (k * bronze % 1.0))] * (high - low) / ordinary
        for _ in range(round(rest / period)):
            yield v
        up = not up
