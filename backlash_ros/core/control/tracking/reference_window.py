"""The references that are to come, those that were, and the noise that they carry."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.numerics import NoiseLevel

Array = NDArray[np.float64]


@lru_cache(maxsize=16)
def _parabolas(preview: int) -> tuple[Array, list[int], list[int]]:
    """What parabolas take from 2 H + 1 references, for several widths w <= H to either side.

    For each width, one below the other, what is left of the middle 2 w + 1 references beside a
    parabola through them, weighted by a Hann window, shape (sum (2 w + 1), 2 H + 1); the first row
    of each; and the widths, none more than a third of the preview.
    """
    widths = [w for w in (3, 8, 20) if 3 * w <= preview]
    half, sizes = max(widths, default=0), [2 * w + 1 for w in widths]
    first = [sum(sizes[:i]) for i in range(len(sizes))]
    fits = np.zeros((sum(sizes), 2 * half + 1))
    for w, row in zip(widths, first, strict=True):
        powers = np.arange(-w, w + 1.0)[:, None] ** np.arange(3)
        weighted = powers * np.hanning(2 * w + 3)[1:-1, None]
        fit = powers @ np.linalg.solve(weighted.T @ powers, weighted.T)
        fits[row:row + 2 * w + 1, half - w:half + w + 1] = np.eye(2 * w + 1) - fit
    return fits, first, widths


def averages(preview: int) -> Array:
    """Weights of no average and of that of each width, shape (widths + 1, 2 H + 1)."""
    fits, first, widths = _parabolas(preview)
    kernels = np.zeros((len(widths) + 1, fits.shape[1]))
    kernels[:, fits.shape[1] // 2] = 1.0
    kernels[1:] -= fits[np.add(first, widths).astype(int)]
    return kernels


class ReferenceWindow:
    """r(k) .. r(k + N) without the noise of y_m, and `history` references before them; preview: N.

    Each reference is replaced by the middle of a parabola through those around it, as many as are
    one but for the noise: steps and turns stay what they are. The newest N / 3 stay as they came.
    noise_gains: standard deviation of u* for noise of 1 that was averaged so, shape (widths,).
    noise_spread: by how much noise parts low and high of the window at most. u_noise_std: largest
    deviation of u* by what is left of the noise.
    """

    def __init__(self, preview: int, history: int, noise_gains: Array) -> None:
        self.noise_gains = noise_gains
        self._preview, self._kept = preview, history + preview + 1
        # As they came, as they are used, and what u* makes of noise of 1 in them. Written from the
        # left to the right; when they are full their end moves to the front.
        self._rows: Array = np.zeros((3, 2 * self._kept))
        self._start = self._end = 0
        self._noise = NoiseLevel()
        self.u_noise_gain = float(noise_gains[0])
        self.u_noise_std = self.noise_spread = self.low = self.high = 0.0

    @property
    def noise_std(self) -> float:
        """Of the references as they came."""
        return self._noise.std

    @property
    def empty(self) -> bool:
        """Whether no reference has come yet."""
        return self._end == 0

    @property
    def window(self) -> Array:
        """r(k) .. r(k + N), shape (N + 1,)."""
        return self._rows[1, self._end - self._preview - 1:self._end]

    def all(self) -> Array:
        """Everything that is kept, the newest last, shape (up to history + N + 1,)."""
        return self._rows[1, max(self._start, self._end - self._kept):self._end]

    def fill(self, value: float) -> None:
        """Let the window begin with this value everywhere."""
        self._start, self._end = 0, self._preview + 1
        self._rows[:2, :self._end] = value
        self._rows[2, :self._end] = 0.0

    def lead_to(self, value: float) -> None:
        """Bend the window so that it leads to a value that is not what would have come next.

        What has become of the reference in between is not known; a jump would be taken for one.
        """
        window = self.window
        jump = value - float(window[-1])
        if self._preview and abs(jump) > float(np.abs(np.diff(window)).max()):
            self._rows[:2, self._end - len(window):self._end] += np.linspace(0.0, jump, len(window))

    def append(self, value: float) -> None:
        """Take in r(k + N)."""
        self._rows[1, self._end] = value
        self._end += 1

    def settle(self) -> None:
        """Make of the newest reference what only the next sample needs."""
        newest, half = self._end - 1, max(_parabolas(self._preview)[2], default=0)
        self._rows[0, newest] = self._rows[1, newest]
        self._rows[2, newest] = self.noise_gains[0]
        self._noise.take(self._rows.item(0, newest))
        std = self._noise.std
        if half and std > 0.0 and newest - self._start >= 2 * half:
            self._average(newest - half)
        window = self.window
        self.low, self.high = float(window.min()), float(window.max())
        if std > 0.0:
            self.noise_spread = 8.0 * std
            first = self._end - self._preview - 1
            self.u_noise_gain = float(self._rows[2, first:max(self._end - half, first + 1)].max())
            self.u_noise_std = std * self.u_noise_gain
        if self._end == self._rows.shape[1]:
            self._rows[:, :self._kept] = self._rows[:, -self._kept:]
            self._start, self._end = 0, self._kept

    def _average(self, at: int) -> None:
        """Average one reference, now that as many after it are known."""
        # Mean square of what is left beside a parabola, in those of the noise, up to which the
        # references are taken for one, and from which on not: at a step, or a sharp turn.
        one, none = 1.8, 3.0
        fits, first, widths = _parabolas(self._preview)
        rest = fits @ self._rows[0, at - widths[-1]:at + widths[-1] + 1]
        of_noise = rest / self._noise.std  # its square may be too small for a number
        squares = np.add.reduceat(of_noise * of_noise, first).tolist()
        reference = value = self._rows.item(0, at)
        gain = float(self.noise_gains[0])
        for i, (w, row, square) in enumerate(zip(widths, first, squares, strict=True)):
            share = min((none - square / (2 * w - 2)) / (none - one), 1.0)
            if share > 0.0:
                value += share * (reference - rest.item(row + w) - value)
                gain += share * (self.noise_gains.item(i + 1) - gain)
        self._rows[1, at], self._rows[2, at] = value, gain
