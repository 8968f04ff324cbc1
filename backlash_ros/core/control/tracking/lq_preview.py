"""LQ tracking of a reference that is known for some samples ahead.

Minimises sum (y - r)^2 + w_i q^2 + rho u^2 with the integral q(k+1) = q(k) + r(k) - y(k):

    u(k) = -K z(k) - sum_{j=0..N} f_j r(k+j),   z = [x; q]

r is taken to stay at its last known value beyond the window.

Reference: M. Tomizuka, Optimal continuous finite preview problem, IEEE Trans. Automatic Control
20 (1975) 362-365; A. Bemporad, lecture form of the affine Riccati recursion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PreviewGains:
    """state: K of x, shape (n,). integral: K of q. preview: f_0 .. f_N, shape (N + 1,)."""

    state: Array
    integral: float
    preview: Array


def preview_gains(
    model: StateModel, input_weight: float, integral_weight: float, window: int,
) -> PreviewGains:
    """Gains for rho = input_weight > 0, w_i = integral_weight >= 0, N = window >= 0.

    Raises ParameterError where G cannot be stabilised or, with w_i > 0, has a zero at z = 1.
    """
    n = model.order
    integrates = integral_weight > 0.0
    size = n + 1 if integrates else n
    a, b, c, e = (
        np.zeros((size, size)), np.zeros((size, 1)), np.zeros(size), np.zeros(size),
    )
    # u in units of 1/sqrt(rho): the Riccati equation is then solved with weights of one size.
    unit = input_weight**-0.5
    a[:n, :n], b[:n, 0], c[0] = model.a, model.b * unit, model.c
    q = np.outer(c, c)
    if integrates:
        a[n, 0], a[n, n], e[n] = -model.c, 1.0, 1.0
        q[n, n] = integral_weight
    try:
        p = linalg.solve_discrete_are(a, b, q, np.eye(1))
    except (linalg.LinAlgError, ValueError):
        raise ParameterError(
            'plant.numerator', 'G(z)', 'cannot be stabilised by feedback of its state',
            'a pole on or outside the unit circle is cancelled, or tracking.integral_weight > 0 '
            'meets a zero at z = 1',
        ) from None
    share = b[:, 0] / (1.0 + float(b[:, 0] @ p @ b[:, 0]))  # (R + B'PB)^-1 B'
    gain = share @ p @ a
    closed = a - b @ gain[None, :]
    # Backward recursion of the affine term s: u = -K z - share' (P e r(k) + s(k+1)).
    per_sample = closed.T @ (p @ e) - c
    preview = np.empty(window + 1)
    preview[0] = share @ p @ e
    row = per_sample
    for j in range(1, window + 1):
        preview[j] = share @ row
        row = closed.T @ row
    # Held beyond the window: the geometric rest of the sum belongs to the last known value.
    preview[window] += share @ linalg.solve(np.eye(size) - closed.T, row)
    return PreviewGains(
        gain[:n] * unit, float(gain[n] * unit) if integrates else 0.0, preview * unit
    )
