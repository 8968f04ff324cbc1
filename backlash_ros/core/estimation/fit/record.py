"""The samples that are fitted: v, and y after it, newest last."""

from __future__ import annotations

from collections.abc import Iterable
from math import nan

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Record:
    """v and y of the newest samples. length: how many; first: number of the oldest one.

    And the v that may have acted instead, nan where there is none.
    """

    def __init__(self, capacity: int) -> None:
        self._v: Array = np.empty(2 * capacity)
        self._y: Array = np.empty(2 * capacity)
        self._other: Array = np.empty(2 * capacity)
        self._begin = self._end = 0
        self.first = 0
        self._doubted: dict[int, float] = {}  # y by the number of the sample

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def end(self) -> int:
        """Number of the next sample."""
        return self.first + len(self)

    def append(self, v: float, y: float, other: float = nan) -> None:
        """Take in a sample, y = nan where it was lost."""
        if self._end == len(self._v):
            self._compact()
        self._v[self._end], self._y[self._end], self._other[self._end] = v, y, other
        self._end += 1

    def since(self, number: int) -> tuple[Array, Array]:
        """v and y of the samples from this number on; they stay what they are."""
        part = slice(self._begin + number - self.first, self._end)
        return self._v[part].copy(), self._y[part].copy()

    def others(self, number: int) -> Array:
        """What may have acted instead of v, from this number on."""
        return self._other[self._begin + number - self.first:self._end].copy()

    def attribute(self, number: int, v: Array) -> int:
        """From this number on these v acted, the ones before them may have been it instead.

        Returns how many are others.
        """
        part = slice(self._begin + number - self.first, self._begin + number - self.first + len(v))
        changed = v != self._v[part]
        self._other[part][changed] = self._v[part][changed]
        self._v[part] = v
        return int(np.count_nonzero(changed))

    def exchange(self, number: int) -> None:
        """The other v acted over this interval."""
        if number >= self.first:
            self.attribute(number, self.others(number)[:1])

    def lose(self, numbers: NDArray[np.intp]) -> None:
        """Count y of these samples as lost."""
        self._y[self._begin + numbers - self.first] = np.nan

    def doubt(self, number: int, y: float) -> None:
        """Keep a y that counts as lost, as it seems to be an outlier."""
        self._doubted[number] = y

    def doubted(self, number: int, count: int) -> Array:
        """The y in doubt among so many samples from this number on, nan where there is none."""
        return np.array([self._doubted.get(k, nan) for k in range(number, number + count)])

    def restore(self, numbers: Iterable[int]) -> None:
        """Count y of these samples, which were in doubt, as measured after all."""
        for number in numbers:
            if number in self._doubted:
                self._y[self._begin + number - self.first] = self._doubted.pop(number)

    def decide_doubts(self, number: int) -> None:
        """Let the y in doubt before this number stay lost: a fit has gone on without them."""
        self._doubted = {k: y for k, y in self._doubted.items() if k >= number}

    def forget_before(self, number: int) -> None:
        """Let go of all samples older than this one."""
        self._begin += number - self.first
        self.first = number
        self.decide_doubts(number)

    def _compact(self) -> None:
        kept = len(self)
        if 2 * kept > len(self._v):
            raise OverflowError(f'record of {kept} samples: let old ones go first')
        for values in (self._v, self._y, self._other):
            values[:kept] = values[self._begin:self._end].copy()
        self._begin, self._end = 0, kept
