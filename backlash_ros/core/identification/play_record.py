"""The play operator over one record, for many gaps: only where v turns does it have to be stepped.

p(k) = clamp(p(k-1), v(k), v(k) + g), equation (2.1) in units of v. While v rises, p = max(p0, v)
with the p0 of the turn before; while it falls, p = min(p0, v + g).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PlayOutput(NamedTuple):
    """p (N,), its derivatives by the gap and by the start (N,), and the turns of p.

    reversals: how often p began to move the other way.
    """

    p: Array
    by_gap: Array
    by_start: Array
    reversals: int


class PlayRecord:
    """v (N,) cut at its turns."""

    def __init__(self, v: Array) -> None:
        self.v = v
        moves = np.diff(v)
        going = np.sign(moves)
        # A sample at rest belongs to the move before it.
        last = np.maximum.accumulate(np.where(going != 0.0, np.arange(len(going)), -1))
        going = np.where(last >= 0, going[np.maximum(last, 0)], 1.0)
        going = np.append(going[:1] if len(going) else 1.0, going)
        turns = np.flatnonzero(np.diff(going)) + 1
        firsts = np.append(0, turns)
        self._ends = np.append(turns, len(v)) - 1
        self._rising = going[firsts] > 0.0
        self._lengths = self._ends - firsts + 1
        self._going_up = np.repeat(self._rising, self._lengths)
        self._turn_values = v[self._ends].tolist()

    @property
    def swing(self) -> float:
        """Largest less smallest v."""
        return float(np.ptp(self.v))

    def output(self, gap: float, start: float) -> PlayOutput:
        """The play output for a gap >= 0 and p before the first sample."""
        held, by_gap, by_start = min(max(start, self.v[0]), self.v[0] + gap), 0.0, 1.0
        if start < self.v[0]:
            by_start = 0.0
        elif start > self.v[0] + gap:
            by_gap, by_start = 1.0, 0.0
        before: list[tuple[float, float, float]] = []
        side = reversals = 0
        for value, rising in zip(self._turn_values, self._rising.tolist(), strict=True):
            before.append((held, by_gap, by_start))
            if rising:
                if value > held:
                    held, by_gap, by_start = value, 0.0, 0.0
                    reversals += side < 0
                    side = 1
            elif value + gap < held:
                held, by_gap, by_start = value + gap, 1.0, 0.0
                reversals += side > 0
                side = -1
        carried = np.repeat(np.array(before), self._lengths, axis=0)
        p0, gap0, start0 = carried.T
        up = self._going_up
        left = self.v + gap
        engaged = np.where(up, self.v > p0, left < p0)
        p = np.where(engaged, np.where(up, self.v, left), p0)
        return PlayOutput(
            p, np.where(engaged, np.where(up, 0.0, 1.0), gap0), np.where(engaged, 0.0, start0),
            reversals,
        )
