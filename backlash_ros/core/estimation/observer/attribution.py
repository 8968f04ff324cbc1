"""Which of two commands acted over an interval, where the time of its arrival leaves that open.

With the other one, u of the interval was another by `change`, and so was the first y that shows it.
The innovation tells the two apart where that is more than the noise: a likelihood ratio against
prior odds.
"""

from __future__ import annotations

from collections.abc import Generator
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import ODDS
from backlash_ros.core.estimation.observer.observer import Observer
from backlash_ros.core.plant.backlash import clamp

Array = NDArray[np.float64]

LEAST_RATIO = 2.0 * log(ODDS)


class Attribution:
    """Judges the intervals as soon as y shows them, those since the last y together.

    A driver that was held up has gone on with the older command until some time between two y: the
    other one acted in the first of these intervals, or in none. observer: that follows y.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        # Samples until y shows it: a first tap that is small beside the others shows little.
        taps = np.abs(observer.model.transfer_function.numerator)
        self._delay = int(np.flatnonzero(taps >= 0.5 * taps.max())[0])
        # What the other commands would have added to the state of the observer, the oldest first.
        self._pending: list[list[float]] = []

    def note(self, change: float) -> None:
        """Take in by how much u would be another in the interval that has just ended."""
        model = self._observer.model.transfer_function
        for added in self._pending:
            model.advance(added, 0.0)
        added = [0.0] * model.order
        model.advance(added, change)
        self._pending.append(added)

    def judge(self, innovation: float) -> tuple[float, list[int]]:
        """Part of this innovation that other commands explain, and how many intervals ago.

        The state of the observer is moved by what they have done to it.
        """
        ripe = len(self._pending) - self._delay + 1
        if ripe <= 0:
            return 0.0, []
        judged, self._pending = self._pending[:ripe], self._pending[ripe:]
        best, count, explained, together = innovation * innovation - self._least, 0, 0.0, 0.0
        for i, added in enumerate(judged, 1):
            together += added[0]
            rest = (innovation - together) ** 2
            if rest < best:
                best, count, explained = rest, i, together
        newest = len(judged) + len(self._pending) - 1
        found = []
        for i, added in enumerate(judged[:count]):
            self._observer.shift(added)
            if any(added):
                found.append(newest - i)
        return explained, found

    @property
    def _least(self) -> float:
        return LEAST_RATIO * self._observer.variance


def attributed(
    v: Array, y: Array, other: Array, play: tuple[float, float], slope: float, offset: float,
    observer: Observer, piece: int,
) -> Generator[None, None, Array]:
    """Return v (N,) of a record with every other one (N,), nan where there is none, that acted.

    play: play output before the record, and the gap. slope, offset: u = slope p - offset. Stops
    after every `piece` samples.
    """
    attribution = Attribution(observer)
    chosen = v.tolist()
    others = other.tolist()
    p, gap = play
    for k, measured in enumerate(y.tolist()):
        if k % piece == piece - 1:
            yield
        value, instead = chosen[k], others[k]
        now = clamp(p, value, value + gap)
        there = clamp(p, instead, instead + gap) if instead == instead else now
        attribution.note(slope * (there - now))
        expected = observer.predict(slope * now - offset)
        if measured == measured:
            innovation = measured - expected
            explained, found = attribution.judge(innovation)
            for ago in found:
                chosen[k - ago] = others[k - ago]
            if 0 in found:
                now = there
            observer.correct(innovation - explained)
        p = now
    return np.array(chosen)
