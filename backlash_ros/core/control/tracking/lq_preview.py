"""LQ tracking of a reference that is known for some samples ahead.

Minimises sum (y - r)^2 + w_i q^2 + rho (u - u_r)^2 with the integral q(k+1) = q(k) + r(k) - y(k):

    u(k) = -K z(k) - sum_{j=0..N} f_j r(k+j),   z = [x; q]

u_r is what holds y at r: r / G(1), as much earlier as G delays slow motion. With it y comes to
rest at r exactly; a weight of u itself would leave y short of it. Where G integrates, u_r = 0.
r is taken to stay at its last known value beyond the window.

Reference: M. Tomizuka, Optimal continuous finite preview problem, IEEE Trans. Automatic Control
20 (1975) 362-365; A. Bemporad, lecture form of the affine Riccati recursion.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.numerics import riccati
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

Array = NDArray[np.float64]


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
    delay = float(np.polyval(np.polyder(a), 1.0) / a_1 - np.polyval(np.polyder(b), 1.0) / b_1)
    whole, part = divmod(min(max(delay, 0.0), float(window)), 1.0)
    taps[int(whole)] = 1.0 - part
    taps[min(int(whole) + 1, window)] += part
    return taps * (a_1 / b_1)
