"""How much of a fit is done at once, so that it fits into the time that a sample leaves."""

from __future__ import annotations

from collections.abc import Generator
from math import inf
from typing import TypeVar

T = TypeVar('T')

LARGEST, SMALLEST = 40_000, 400  # samples times alternatives in one piece
LONG, SHORT = 0.5, 0.1  # shares of the time beyond which a piece is made smaller, or larger


class Pace:
    """Size of the pieces, from how long the last ones took. size: samples times alternatives."""

    def __init__(self) -> None:
        self.size = LARGEST

    def note(self, took_s: float, budget_s: float) -> None:
        """Take in how long a piece took, and how long all of them may take between two samples."""
        if budget_s == inf or took_s < SHORT * budget_s:
            self.size = min(2 * self.size, LARGEST)
        elif took_s > LONG * budget_s:
            self.size = max(self.size // 2, SMALLEST)

    def pieces(self, samples: int) -> int:
        """Alternatives over so many samples that fit into one piece."""
        return max(self.size // max(samples, 1), 1)


def drained(work: Generator[object, None, T]) -> T:
    """What a generator returns once all of its pieces are done."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            result: T = done.value
            return result
