"""The play operator over a record: which side is engaged, and what the regression makes of it.

u = m (p - c_r) with the play output p(k) = clamp(p(k-1), v, v + g) for the gap g = c_r - c_l: p = v
on the right side, p = v + g on the left one, and p is held in between, equation (2.1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.backlash import play_outputs

Array = NDArray[np.float64]

NO_PAST: Array = np.empty(0)


class Labels(NamedTuple):
    """What the play operator says of N samples, each of shape (N,).

    right, left: side engaged last (1.0 or 0.0). held: neither side was engaged yet. v_a: v of the
    last engaged sample, 0 while held. moves: p(k) - p(k-1), without the first engagement. jump: 1.0
    where that was. p: play output.
    """

    right: Array
    left: Array
    held: Array
    v_a: Array
    moves: Array
    jump: Array
    p: Array

    @property
    def reversals(self) -> int:
        """How often the engaged side changed."""
        side = (self.right - self.left)[self.held == 0.0]
        return int(np.count_nonzero(np.diff(side)))


def labels_of(v: Array, gap: float, p0: float, side: int = 0, v_a: float = 0.0) -> Labels:
    """Labels of v (N,) for the play output p0 before it.

    side: 1, -1: engaged last before the record at v_a; 0: p0 is where it was left, unknown to v.
    """
    p, sides = play(v, gap, p0)
    return labels_from(v, p, sides, p0, side, v_a)


def labels_from(
    v: Array, p: Array, sides: NDArray[np.int8], p0: float, side: int, v_a: float,
) -> Labels:
    """The same for a play output p (N,) and sides (N,) that are known."""
    engaged = np.flatnonzero(sides)
    count = len(v)
    # At each sample the number of engaged ones so far: what is said of the last of these.
    number = np.cumsum(sides != 0)
    sign = np.concatenate([[side], sides[engaged]])[number]
    anchor = np.concatenate([[v_a if side else 0.0], v[engaged]])[number]
    moves = np.empty(count)
    moves[:1], moves[1:] = p[:1] - p0, p[1:] - p[:-1]
    jump = np.zeros(count)
    if side == 0 and len(engaged):
        first = engaged[0]
        jump[first], moves[first] = 1.0, 0.0
    right, left, held = np.equal.outer((1, -1, 0), sign).astype(float)
    return Labels(right, left, held, anchor, moves, jump, p)


def play(v: Array, gap: float, p0: float) -> tuple[Array, NDArray[np.int8]]:
    """Play output p (N,) and side engaged at each sample: 1 right, -1 left, 0 in the gap."""
    p = np.array(play_outputs(v.tolist(), gap, p0))
    right = p == v
    return p, np.subtract(right, (p == v + gap) > right, dtype=np.int8)


def plays(v: Array, gaps: Array, p0: Array) -> Array:
    """Play output for many gaps (H,) and starts (H,), shape (H, N).

    Only where v turns it has to be stepped: while v rises, p = max(p, v) with the p of the turn
    before; while it falls, p = min(p, v + gap).
    """
    rising = np.concatenate([[False], v[1:] > v[:-1]])
    last: Array = np.append(np.flatnonzero(rising[1:] != rising[:-1]), len(v) - 1)
    held = np.minimum(np.maximum(p0, v[0]), v[0] + gaps)
    before = np.empty((len(gaps), len(last)))
    for k, (value, up) in enumerate(zip(v[last].tolist(), rising[last].tolist(), strict=True)):
        before[:, k] = held
        held = np.maximum(held, value) if up else np.minimum(held, value + gaps)
    p = np.repeat(before, np.diff(last, prepend=-1), axis=1)
    return np.where(rising, np.maximum(p, v), np.minimum(p, v + gaps[:, None]))


class Start(NamedTuple):
    """Where the play operator begins. gap: of the labels.

    p: play output before the first sample. side: 1 or -1 where one was engaged before, at v_a; 0
    where the plant was left somewhere in its gap. past: v before the record, from where all this
    holds on: what it did to the error of G lasts.
    """

    gap: float
    p: float
    side: int = 0
    v_a: float = 0.0
    past: Array = NO_PAST

    def labels(self, v: Array) -> Labels:
        """What the play operator says of v (N,) from here on."""
        return labels_of(v, self.gap, self.p, self.side, self.v_a)

    def after(self, v: Array) -> Start:
        """Where the play operator stands after v (N,)."""
        if not len(v):
            return self
        return self.at_end(self.labels(v))

    def at_end(self, labels: Labels) -> Start:
        """The same after these samples, at least one."""
        side = int(labels.right[-1] - labels.left[-1])
        return Start(self.gap, float(labels.p[-1]), side, float(labels.v_a[-1]))

    def forgotten_after(self, v: Array) -> int:
        """Samples of v (N,) after which p says nothing any more; N + 1 if it always does."""
        if self.side != 0:
            return len(v) + 1
        low = float(v[0])
        ends = (play(v, self.gap, p)[0] for p in (low, low + self.gap))
        same = np.flatnonzero(np.equal(*ends))
        return int(same[0]) + 1 if same.size else len(v) + 1

    def with_gap(self, gap: float, v: Array) -> Start:
        """The same for another gap, before v (N,): a side that was engaged stays so."""
        gap = max(gap, 0.0)
        if self.side != 0:
            return self._replace(gap=gap, p=self.v_a + (gap if self.side < 0 else 0.0))
        low = float(self.past[0] if len(self.past) else v[0])
        return self._replace(gap=gap, p=min(max(self.p, low), low + gap))
