"""Cramér–Rao bound of (m, c_r, c_l) for the v that was really applied.

Independent of the estimator: the sensitivities of y to x0 and to theta are simulated with
scipy.signal from the true mode sequence, and the Fisher information is inverted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]


def engaged_regressors(v: Array, m: float, c_r: float, c_l: float, u: float) -> Array:
    """phi(k) of u(k) = phi' (m, m c_r, m c_l, u_0), shape (N, 4); u is held at first."""
    rows = np.zeros((len(v), 4))
    row = np.array([0.0, 0.0, 0.0, 1.0])
    for k, value in enumerate(v):
        if u <= m * (value - c_r):
            u, row = m * (value - c_r), np.array([value, -1.0, 0.0, 0.0])
        elif u >= m * (value - c_l):
            u, row = m * (value - c_l), np.array([value, 0.0, -1.0, 0.0])
        rows[k] = row
    return rows


def cramer_rao(
    v: Array, numerator: Array, denominator: Array, truth: tuple[float, float, float],
    noise_std: float, received: NDArray[np.bool_] | None = None, u0: float = 0.0,
) -> Array:
    """Smallest standard deviations of (m, c_r, c_l) from y(0..N), v(0..N-1) applied, shape (3,).

    received: which of y(0..N) arrived. Unknown are x(0), theta and the u held at the start.
    """
    m, c_r, c_l = truth
    phi = np.vstack([engaged_regressors(v, m, c_r, c_l, u0), np.zeros((1, 4))])
    b = np.concatenate([np.zeros(len(denominator) - len(numerator)), numerator])
    forced = [signal.lfilter(b, denominator, phi[:, i]) for i in range(4)]
    order = len(denominator) - 1
    free = [
        signal.lfilter(np.ones(1), denominator, np.eye(1, len(phi), i)[0]) for i in range(order)
    ]
    columns = np.column_stack(forced[:3] + free + ([forced[3]] if np.any(forced[3]) else []))
    if received is not None:
        columns = columns[received]
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    r = np.linalg.qr(columns / size, mode='r')
    inverse = np.linalg.pinv(r, rcond=1e-14)
    cov = (inverse @ inverse.T) / np.outer(size, size) * noise_std**2
    jacobian = np.array([[1.0, 0, 0], [-c_r / m, 1 / m, 0], [-c_l / m, 0, 1 / m]])
    return np.asarray(np.sqrt(np.diag(jacobian @ cov[:3, :3] @ jacobian.T)))
