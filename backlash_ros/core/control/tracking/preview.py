"""LQ tracking of a reference that is known for some samples ahead, and the noise in it.

Minimises sum (y - r)^2 + w_i q^2 + rho (u - u_r)^2 with the integral q(k+1) = q(k) + r(k) - y(k):

    u(k) = -K z(k) - sum_{j=0..N} f_j r(k+j),   z = [x; q]

u_r is what holds y at r: r / G(1), as much earlier as G delays slow motion; 0 where G integrates.
A weight of u itself would leave y short of r. r stays at its last known value beyond the window.

Reference: M. Tomizuka, Optimal continuous finite preview problem, IEEE Trans. Automatic Control
20 (1975) 362-365; A. Bemporad, lecture form of the affine Riccati recursion.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.numerics import NoiseLevel, riccati
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction


class PreviewGains(NamedTuple):
    """state: K of x, shape (n,). integral: K of q. preview: f_0 .. f_N, shape (N + 1,)."""

    state: Array
    integral: float
    preview: Array


# A controller restarts in the middle of a loop, and must not wait for them then.
@lru_cache(maxsize=64)
def preview_gains(
    model: StateModel, input_weight: float, integral_weight: float = 0.0, window: int = 0,
) -> PreviewGains:
    """Gains for rho = input_weight > 0, w_i = integral_weight >= 0, N = window >= 0.

    Raises ParameterError where G cannot be stabilised or, with w_i > 0, has a zero at z = 1.
    """
    n, integrates = model.order, integral_weight > 0.0
    size = n + integrates
    a, b, c, e = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
    # u in units of 1/sqrt(rho): the Riccati equation is then solved with weights of one size.
    unit = input_weight**-0.5
    a[:n, :n], b[:n], c[0] = model.a, model.b * unit, model.c
    q: Array = np.asarray(np.outer(c, c), np.float64)
    if integrates:
        a[n, 0], a[n, n], e[n], q[n, n] = -model.c, 1.0, 1.0, integral_weight
    try:
        p = riccati(a, b, q)
    except np.linalg.LinAlgError:
        raise ParameterError(
            'plant.numerator', 'G(z)', 'cannot be stabilised by feedback of its state',
            'a pole on or outside the unit circle is cancelled, or tracking.integral_weight > 0 '
            'meets a zero at z = 1',
        ) from None
    share = b / (1.0 + float(b @ p @ b))  # (R + B'PB)^-1 B'
    gain = share @ p @ a
    closed = a - np.outer(b, gain)
    preview = _preview(share, closed, p @ e, c, window) * unit
    # u = u_r + u': what is weighed is u', and u_r drives G besides.
    by_u_r = _preview(share, closed, p @ b, np.zeros(size), window)
    by_u_r[0] -= 1.0
    of_each = np.convolve(by_u_r, _holding(model.transfer_function, window))
    preview += of_each[:window + 1]
    preview[window] += of_each[window + 1:].sum()
    return PreviewGains(gain[:n] * unit, float(gain[n] * unit) if integrates else 0.0, preview)


def _preview(share: Array, closed: Array, first: Array, c: Array, window: int) -> Array:
    """Gains f_0 .. f_N of a signal w in z(k+1) = A z + B u + e w, from P e = first, and y - w.

    The backward recursion of the affine term s: u = -K z - share' (P e w(k) + s(k+1)).
    """
    gains = np.empty(window + 1)
    gains[0] = share @ first
    row = closed.T @ first - c
    for j in range(1, window + 1):
        gains[j] = share @ row
        row = closed.T @ row
    # Held beyond the window: the geometric rest of the sum belongs to the last known value.
    gains[window] += share @ np.linalg.solve(np.eye(len(c)) - closed.T, row)
    return gains


def _holding(model: TransferFunction, window: int) -> Array:
    """h with u_r(k) = sum_j h_j r(k+j), shape (N + 1,)."""
    taps = np.zeros(window + 1)
    b, a = model.numerator, model.denominator
    b_1, a_1 = float(b.sum()), float(a.sum())
    # Less than rounding of the coefficients is a zero or a pole at z = 1.
    if abs(b_1) <= 1e-9 * np.abs(b).sum() or abs(a_1) <= 1e-9 * np.abs(a).sum():
        return taps  # nothing holds y, or u = 0 does
    whole, part = divmod(min(max(model.group_delay, 0.0), float(window)), 1.0)
    taps[int(whole)] = 1.0 - part
    taps[min(int(whole) + 1, window)] += part
    return taps * (a_1 / b_1)


# --- references that carry noise ----------------------------------------------------------------


@lru_cache(maxsize=16)
def _parabolas(preview: int) -> tuple[Array, list[int], list[int]]:
    """What of 2 H + 1 references is left beside parabolas through the middle 2 w + 1 of them.

    For several widths w <= H, at most a third of the preview, one below the other: shape
    (sum (2 w + 1), 2 H + 1); then their first rows, and the widths.
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

    Each is replaced by the middle of a parabola through those around it, as many as are one but for
    the noise; the newest N / 3 stay. noise_gains: deviation of u* for noise of 1 that was averaged
    so, shape (widths,). u_noise_std: largest deviation of u* by what is left of the noise.
    """

    def __init__(self, preview: int, history: int, noise_gains: Array) -> None:
        self.noise_gains = noise_gains
        self._preview, self._kept = preview, history + preview + 1
        # As they came, as they are used, and what u* makes of noise of 1 in them. Written from the
        # left to the right; when they are full their end moves to the front.
        self._rows: Array = np.zeros((3, 2 * self._kept))
        self._start = self._end = 0
        self.noise = NoiseLevel()  # of the references as they came
        self.u_noise_gain = float(noise_gains[0])
        self.u_noise_std = self.noise_spread = self.low = self.high = 0.0

    @property
    def empty(self) -> bool:
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
        """Bend the window so that it leads to a value that is not what would have come next."""
        window = self.window
        jump = value - float(window[-1])
        # What has become of the reference in between is not known; a jump would be taken for one.
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
        self.noise.take(self._rows.item(0, newest))
        std = self.noise.std
        if half and std > 0.0 and newest - self._start >= 2 * half:
            self._average(newest - half)
        window = self.window
        self.low, self.high = float(window.min()), float(window.max())
        if std > 0.0:
            self.noise_spread = 8.0 * std  # by as much it parts low and high at most
            first = self._end - self._preview - 1
            self.u_noise_gain = float(self._rows[2, first:max(self._end - half, first + 1)].max())
            self.u_noise_std = std * self.u_noise_gain
        if self._end == self._rows.shape[1]:
            self._rows[:, :self._kept] = self._rows[:, -self._kept:]
            self._start, self._end = 0, self._kept

    def _average(self, at: int) -> None:
        # Mean square of what is left beside a parabola, in those of the noise, up to which the
        # references are taken for one, and from which on not: at a step, or a sharp turn.
        one, none = 1.8, 3.0
        fits, first, widths = _parabolas(self._preview)
        rest = fits @ self._rows[0, at - widths[-1]:at + widths[-1] + 1]
        of_noise = rest / self.noise.std  # its square may be too small for a number
        squares = np.add.reduceat(of_noise * of_noise, first).tolist()
        reference = value = self._rows.item(0, at)
        gain = float(self.noise_gains[0])
        for i, (w, row, square) in enumerate(zip(widths, first, squares, strict=True)):
            share = min((none - square / (2 * w - 2)) / (none - one), 1.0)
            if share > 0.0:
                value += share * (reference - rest.item(row + w) - value)
                gain += share * (self.noise_gains.item(i + 1) - gain)
        self._rows[1, at], self._rows[2, at] = value, gain
