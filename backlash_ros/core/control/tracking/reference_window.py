"""The references that are to come, those that were, and the noise that they carry."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.numerics import NoiseLevel

Array = NDArray[np.float64]


class Parabolas(NamedTuple):
    """What parabolas take from 2 H + 1 references, for several widths w <= H to either side.

    fits: for each width, one below the other, what is left of the middle 2 w + 1 references beside
    a parabola through them, shape (sum (2 w + 1), 2 H + 1). first: row of each width. degrees: of
    freedom of its rest. middle: rest of the middle reference, as a row of all.
    """

    fits: Array
    first: list[int]
    degrees: list[int]
    middle: list[int]

    @property
    def half(self) -> int:
        """H."""
        return self.fits.shape[1] // 2


@lru_cache(maxsize=16)
def parabolas(preview: int) -> Parabolas:
    """No width is more than a third of the preview. The fit is weighted by a Hann window."""
    widths = [w for w in (3, 8, 20) if 3 * w <= preview]
    half, sizes = max(widths, default=0), [2 * w + 1 for w in widths]
    first = [sum(sizes[:i]) for i in range(len(sizes))]
    fits = np.zeros((sum(sizes), 2 * half + 1))
    for w, row in zip(widths, first, strict=True):
        powers = np.arange(-w, w + 1.0)[:, None] ** np.arange(3)
        weighted = powers * np.hanning(2 * w + 3)[1:-1, None]
        fit = powers @ np.linalg.solve(weighted.T @ powers, weighted.T)
        fits[row:row + 2 * w + 1, half - w:half + w + 1] = np.eye(2 * w + 1) - fit
    return Parabolas(fits, first, [2 * w - 2 for w in widths],
                     [row + w for w, row in zip(widths, first, strict=True)])


def averages(preview: int) -> Array:
    """Weights of no average and of that of each width, shape (widths + 1, 2 H + 1)."""
    fits = parabolas(preview)
    kernels = np.zeros((len(fits.first) + 1, 2 * fits.half + 1))
    kernels[:, fits.half] = 1.0
    kernels[1:] -= fits.fits[fits.middle]
    return kernels


class ReferenceWindow:
    """r(k) .. r(k + N) without the noise of y_m, and what came before.

    Each reference is replaced by the middle of a parabola through those around it, as many as are
    one but for the noise: steps and turns stay what they are, and without noise nothing changes.
    The newest N / 3 stay as they came.

    preview: N. history: how many references before r(k) are kept. noise_gains: standard deviation
    of u* for noise of 1 that was averaged so, shape (widths,). What `settle` has found within the
    window: low, high; noise_spread, by how much noise parts them at most; u_noise_std, largest
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
        newest, half = self._end - 1, parabolas(self._preview).half
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
            last = max(self._end - half, first + 1)
            self.u_noise_gain = float(self._rows[2, first:last].max())
            self.u_noise_std = std * self.u_noise_gain
        if self._end == self._rows.shape[1]:
            self._rows[:, :self._kept] = self._rows[:, -self._kept:]
            self._start, self._end = 0, self._kept

    def _average(self, at: int) -> None:
        """Average one reference, now that as many after it are known."""
        # Mean square of what is left beside a parabola, in those of the noise, up to which the
        # references are taken for one, and from which on not: at a step, or a sharp turn.
        one, none = 1.8, 3.0
        beside = parabolas(self._preview)
        fits, first, degrees, middle = beside
        half, came, noise = beside.half, self._rows[0], self._noise.std
        rest = fits @ came[at - half:at + half + 1]
        of_noise = rest / noise  # its square may be too small for a number
        squares = np.add.reduceat(of_noise * of_noise, first).tolist()
        reference = value = came.item(at)
        gain = float(self.noise_gains[0])
        for i, square in enumerate(squares):
            share = min((none - square / degrees[i]) / (none - one), 1.0)
            if share > 0.0:
                value += share * (reference - rest.item(middle[i]) - value)
                gain += share * (self.noise_gains.item(i + 1) - gain)
        self._rows[1, at], self._rows[2, at] = value, gain
