"""How much of a fit is done at once, so that it fits into the time that a sample leaves."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar

T = TypeVar('T')

LARGEST = 40_000  # samples times alternatives in one piece: what a cache holds
# Of them per second of the time there is, which are done at once whatever they take: in smaller
# pieces the calls would take longer than the work.
SLOWEST = 2.5e6
LONG = 0.5  # share of the time beyond which a piece is made smaller


class Pace:
    """Size of the pieces, from how long the last ones took. size: samples times alternatives."""

    def __init__(self) -> None:
        self.size = LARGEST
        self._asked = False  # whether the piece that is under way depends on it

    def note(self, took_s: float, budget_s: float) -> None:
        """Take in how long a piece took, and how long all of them may take between two samples.

        took_s: of processor time. A piece that was held up by others would be no faster if smaller.
        """
        asked, self._asked = self._asked, False
        if not asked:
            return
        if took_s > LONG * budget_s:
            self.size = max(self.size // 2, int(SLOWEST * budget_s))
        elif 2.0 * took_s < LONG * budget_s:
            self.size = min(2 * self.size, LARGEST)

    def pieces(self, samples: int) -> int:
        """Alternatives over so many samples that fit into one piece."""
        self._asked = True
        return max(self.size // max(samples, 1), 1)


def drained(work: Generator[object, None, T]) -> T:
    """What a generator returns once all of its pieces are done."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            result: T = done.value
            return result
