"""Cramér–Rao bound of (m, c_r, c_l) for the v that was really applied.

Independent of the estimator: the sensitivities of y to x(0) and to theta are simulated with
scipy.signal from the true mode sequence, and the Fisher information is inverted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

Array = NDArray[np.float64]

SINGULAR = 1e-13  # of the largest singular value: a direction that y does not show


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
    effects: Callable[[Array], Array] | None = None,
) -> Array:
    """Smallest standard deviations of (m, c_r, c_l) from y(0..N), v(0..N-1) applied, shape (3,).

    received: which of y(0..N) arrived. Unknown are x(0), theta and the u held at the start.
    effects: what a standard deviation of each of K other unknowns does to y, shape (N+1, K), from
    u(0..N); these are known beforehand to be normal around their true values (Van Trees).
    inf where y does not show a parameter.
    """
    m, c_r, c_l = truth
    phi = np.vstack([engaged_regressors(v, m, c_r, c_l, u0), np.zeros((1, 4))])
    b = np.concatenate([np.zeros(len(denominator) - len(numerator)), numerator])
    forced = [signal.lfilter(b, denominator, phi[:, i]) for i in range(4)]
    impulses = np.eye(len(denominator) - 1, len(phi))
    free = [signal.lfilter(np.ones(1), denominator, impulse) for impulse in impulses]
    held = [forced[3]] if np.any(forced[3]) else []
    sensitivity = np.column_stack([*forced[:3], *free, *held])
    if effects is not None:
        sensitivity = np.hstack([sensitivity, effects(phi @ [m, m * c_r, m * c_l, u0])])
    if received is not None:
        sensitivity = sensitivity[received]
    if effects is not None:
        prior = noise_std * np.eye(sensitivity.shape[1])[3 + len(free) + len(held):]
        sensitivity = np.vstack([sensitivity, prior])
    jacobian = np.array([[1.0, 0, 0], [-c_r / m, 1 / m, 0], [-c_l / m, 0, 1 / m]])
    root, hidden = _theta_root(sensitivity)
    # Each column of root is one direction of the data: the norms are standard deviations.
    bound = noise_std * np.linalg.norm(jacobian @ root, axis=1)
    bound[np.abs(jacobian) @ hidden > 0.0] = np.inf
    return np.asarray(bound)


def _theta_root(sensitivity: Array) -> tuple[Array, Array]:
    """Return L with L L' = the first 3 x 3 block of the inverse information for unit noise.

    The second value says how much of each theta lies in directions that y does not show.
    """
    size = np.linalg.norm(sensitivity, axis=0)
    size[size == 0.0] = 1.0
    r = linalg.qr(sensitivity / size, mode='r')[0][: len(size)]
    _, singular, rows = linalg.svd(r)
    lost = singular <= SINGULAR * singular[0]
    root = rows[~lost, :3].T / singular[~lost] / size[:3, None]
    hidden = np.abs(rows[lost, :3]).max(axis=0, initial=0.0)
    hidden[hidden < np.sqrt(SINGULAR)] = 0.0
    return np.asarray(root), np.asarray(hidden)
