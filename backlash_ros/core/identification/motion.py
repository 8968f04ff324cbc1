"""Motion of v made for identification: several speeds, amplitudes and rests, in both directions.

A lag shows as a gap that grows with the speed: with one speed only, they could not be told apart.
Strokes at the speed limit, with rests between, show what is fast in G.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

GOLDEN, SILVER, BRONZE = 0.6180339887, 0.4142135624, 0.3027756377  # spread evenly, never repeat
STROKES = 24  # strokes across the range in the whole motion, at its ordinary largest speed
SLOWEST = 0.15  # of that speed
AT_LIMIT = 3  # every so many strokes are as fast as the actuator may move
SMALLEST, LARGEST = 0.35, 0.9  # parts of the way to the end of the range of a stroke that is short
RESTS = (0.0, 0.1, 0.35)  # after a stroke, in times of one across the range at the ordinary speed


def strokes(
    low: float, high: float, rate: float, period: float, duration: float, v: float,
) -> Iterator[float]:
    """v(k), one per sample, without end, beginning at v.

    low, high, rate: limits of v and of its speed [v/s]. period: of a sample [s]. duration: in which
    the record is to be complete [s].
    """
    ordinary = min(rate, STROKES * (high - low) / duration)
    up = v <= 0.5 * (low + high)
    for k in count():
        # Two strokes from end to end, for a gap may be nearly as wide, then two short ones.
        part = 1.0 if k % 4 < 2 else SMALLEST + (LARGEST - SMALLEST) * (k * GOLDEN % 1.0)
        target = v + part * ((high - v) if up else (low - v))
        target = min(max(target, low), high)  # whatever rounding does
        fast = k % AT_LIMIT == AT_LIMIT - 1
        speed = rate if fast else ordinary * SLOWEST ** ((0.13 + k * SILVER) % 1.0)
        move = speed * period
        while v != target:
            v = min(v + move, target) if v < target else max(v - move, target)
            yield v
        rest = RESTS[int(len(RESTS) * ((k * BRONZE) % 1.0))] * (high - low) / ordinary
        for _ in range(round(rest / period)):
            yield v
        up = not up
