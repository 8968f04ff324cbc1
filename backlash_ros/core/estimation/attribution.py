"""Which of two commands acted over an interval, where the time of its arrival leaves that open.

With the other one, u of the interval was another by `change`, and the first y that shows it another
by first * change. The innovation tells the two apart where that is more than the noise: a
likelihood ratio against prior odds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.backlash import clamp
from backlash_ros.core.estimation.constants import ODDS
from backlash_ros.core.estimation.observer import Observer

Array = NDArray[np.float64]

LEAST = 2.0 * log(ODDS)


class Attribution:
    """Judges the intervals one after the other, as soon as y shows them.

    A change is judged `delay` outputs after its interval has begun, delay >= 1 being that of G.
    """

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.delay = observer.model.transfer_function.delay
        self._changes: deque[float] = deque([0.0] * self.delay, maxlen=self.delay)

    def note(self, change: float) -> None:
        """Take in by how much u would be another in the interval that has just ended."""
        self._changes.append(change)

    def is_other(self, innovation: float) -> float:
        """Part of this innovation that the other command explains; 0 where it was not the one.

        The state of the observer is moved by what the other one has done to it.
        """
        change = self._changes[0]
        if change == 0.0:
            return 0.0
        observer = self._observer
        explained = observer.first * change
        rest = innovation - explained
        if innovation * innovation - rest * rest <= LEAST * observer.variance:
            return 0.0
        observer.shift(change)
        return explained


def attributed(
    v: Array, y: Array, other: Array, play: tuple[float, float], slope: float, offset: float,
    observer: Observer, piece: int,
) -> Generator[None, None, Array]:
    """Return v (N,) of a record with every other one (N,), nan where there is none, that acted.

    play: play output before the record, and the gap. slope, offset: u = slope p - offset. Stops
    after every `piece` samples.
    """
    attribution = Attribution(observer)
    behind = attribution.delay - 1
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
            explained = attribution.is_other(innovation)
            if explained != 0.0 and k >= behind:
                chosen[k - behind] = others[k - behind]
                if behind == 0:
                    now = there
            observer.correct(innovation - explained)
        p = now
    return np.array(chosen)
