"""Samples of the loop: a window to which a backlash is fitted, and the recorder that fills it."""

from typing import NamedTuple

import numpy as np

from backlash_ros.core.plant.backlash import engaged, play, reversals
from backlash_ros.core.plant.transfer_function import Array


class Window(NamedTuple):
    """Samples from number `first` on, all (N,): v that acted; y after it, nan if lost; `other`, the
    v that may have acted instead, nan if there is no doubt."""

    first: int
    v: Array
    y: Array
    other: Array

    @property
    def end(self) -> int:
        return self.first + len(self.v)

    @property
    def is_open(self) -> bool:
        """Whether it is in doubt anywhere which command acted."""
        return bool(np.isfinite(self.other).any())

    def between(self, first: int, end: int | None = None) -> 'Window':
        """The samples from number `first` up to, but without, `end`."""
        begin = max(first - self.first, 0)
        part = slice(begin, None if end is None else max(end - self.first, 0))
        return Window(self.first + begin, self.v[part], self.y[part], self.other[part])

    def places(self, numbers: frozenset[int]) -> list[int]:
        return [k - self.first for k in numbers if self.first <= k < self.end]

    def swapped(self, numbers: frozenset[int]) -> 'Window':
        """The window with the other command acting in the intervals of these samples."""
        places, v, other = self.places(numbers), self.v.copy(), self.other.copy()
        v[places], other[places] = self.other[places], self.v[places]
        return self._replace(v=v, other=other)

    def without(self, numbers: frozenset[int]) -> 'Window':
        """The window with these readings of y marked as lost."""
        y = self.y.copy()
        y[self.places(numbers)] = np.nan
        return self._replace(y=y)

    def turns(self, gap: float, p0: float) -> int:
        return len(reversals(engaged(self.v, play(self.v, gap, p0), gap)))


class Recorder:
    """Keeps at least the newest `capacity` samples. end: number of the next sample."""

    def __init__(self, capacity: int) -> None:
        self.end, self._capacity = 0, capacity
        # Separate arrays: from 4 MB on NumPy asks for huge pages, and one sample would claim them.
        self._kept = Window(0, *(np.empty(2 * capacity) for _ in Window._fields[1:]))

    def append(self, v: float, y: float, other: float) -> None:
        kept, at = self._kept, self.end - self._kept.first
        if at == len(kept.v):
            # Into new arrays: a fit may still be reading these.
            first, *newest = kept.between(self.end - self._capacity)
            doubled = (np.concatenate([each, np.empty_like(each)]) for each in newest)
            kept, at = Window(first, *doubled), self._capacity
            self._kept = kept
        kept.v[at], kept.y[at], kept.other[at] = v, y, other
        self.end += 1

    def since(self, first: int) -> Window:
        """The samples kept from number `first` on; they no longer change."""
        return self._kept.between(first, self.end)
