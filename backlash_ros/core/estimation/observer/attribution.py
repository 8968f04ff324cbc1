"""Which of two commands acted, as soon as y shows it: the time of arrival may leave that open.

With the other one, u of the interval was another by `change`, and so was the first y that shows it.
The innovation tells the two apart where that is more than the noise: a likelihood ratio against
prior odds.
"""

from __future__ import annotations

from math import log

import numpy as np

from backlash_ros.core.estimation.constants import ODDS
from backlash_ros.core.estimation.observer.observer import Observer

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
