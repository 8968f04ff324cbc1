"""Stationary solutions of the Riccati and the Lyapunov equation, by doubling.

SciPy solves them too, but takes a controller 31 MB that nothing else in its process needs.

Reference: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Structure-preserving algorithms for
periodic discrete-time algebraic Riccati equations, Int. J. Control 77 (2004) 767-788.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def riccati(a: Array, b: Array, q: Array) -> Array:
    """P = A'PA - A'PB (1 + B'PB)^-1 B'PA + Q, the stabilising one, shape (n, n).

    a: (n, n). b: (n,). q: (n, n), positive semidefinite. The gain (1 + B'PB)^-1 B'PA stabilises
    (A, B); with (A', C') for them and Q of the noise P is the covariance of a Kalman filter.
    Raises numpy.linalg.LinAlgError where there is none.
    """
    transition, g, p = a.copy(), np.outer(b, b), np.array(q, np.float64)
    unit = np.eye(len(a))
    with np.errstate(over='ignore', invalid='ignore'):
        for _ in range(60):  # each time the solution covers twice as many samples
            inner = np.linalg.solve(unit + g @ p, np.hstack([transition, g]))
            more = transition.T @ p @ inner[:, :len(a)]
            g += transition @ inner[:, len(a):] @ transition.T
            transition = transition @ inner[:, :len(a)]
            p += 0.5 * (more + more.T)
            if not np.isfinite(p).all():
                break
            if float(np.abs(more).max()) <= 1e-16 * float(np.abs(p).max()):
                return p
    raise np.linalg.LinAlgError('no feedback stabilises A')


def lyapunov(a: Array, q: Array) -> Array:
    """P = A P A' + Q for a stable A, shape (n, n); raises numpy.linalg.LinAlgError for another."""
    return riccati(a.T, np.zeros(len(a)), q)
