"""The last references side by side in memory, so that a window of them is a view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ReferenceWindow:
    """r(k) .. r(k + N), and what came before.

    preview: N. history: how many references before r(k) are kept.
    """

    def __init__(self, preview: int, history: int) -> None:
        self.history = history
        self._preview, self._kept = preview, history + preview + 1
        # Written from the left to the right; when it is full its end moves to the front.
        self._values: Array = np.zeros(2 * self._kept)
        self._start = self._end = 0

    @property
    def empty(self) -> bool:
        """Whether no reference has come yet."""
        return self._end == 0

    def fill(self, value: float) -> None:
        """Let the window begin with this value everywhere."""
        self._start, self._end = 0, self._preview + 1
        self._values[:self._end] = value

    def lead_to(self, value: float) -> None:
        """Bend the window so that it leads to a value that is not what would have come next.

        What has become of the reference in between is not known; a jump would be taken for one.
        """
        window = self.window
        jump = value - float(window[-1])
        if self._preview and abs(jump) > float(np.abs(np.diff(window)).max()):
            window += np.linspace(0.0, jump, len(window))

    def append(self, value: float) -> Array:
        """Take in r(k + N) and return r(k) .. r(k + N), shape (N + 1,)."""
        end = self._end
        if end == len(self._values):
            kept = self._kept - 1
            self._values[:kept] = self._values[end - kept:]
            self._start, end = 0, kept
        self._values[end] = value
        self._end = end + 1
        return self.window

    @property
    def window(self) -> Array:
        """r(k) .. r(k + N) once more, shape (N + 1,)."""
        return self._values[self._end - self._preview - 1:self._end]

    def all(self) -> Array:
        """Everything that is kept, the newest last, shape (up to history + N + 1,)."""
        return self._values[max(self._start, self._end - self._kept):self._end]
