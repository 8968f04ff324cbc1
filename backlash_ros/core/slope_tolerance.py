"""Whether feedback that was designed for one slope of the backlash bears another one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.state_model import StateModel

Array = NDArray[np.float64]

# Variance of the disturbance per sample, seen in y, over that of the noise on y: from an observer
# that believes its model to one that believes y alone.
CONFIDENCES = (1e-4, 1e-1, 1e2, 1e5)


def tolerates(model: StateModel, gain: Array, factor: float) -> bool:
    """Whether u = -gain x_hat keeps G stable although u acts `factor` times as strongly.

    x_hat comes from an observer of [x; d] that does not know of the factor, d being a slow
    disturbance of u (FixedBacklash). gain: shape (n,). The gap itself is left out: it limits what
    u can do wrong, but not for ever.
    """
    return all(
        _spectral_radius(model, gain, factor, confidence) < 1.0 for confidence in CONFIDENCES
    )


def _spectral_radius(model: StateModel, gain: Array, factor: float, confidence: float) -> float:
    """Of the closed loop with the state [x; x_hat; d_hat]; inf where no observer exists."""
    n, a, b = model.order, model.a, model.b
    believed = np.eye(n + 1)
    believed[:n, :n], believed[:n, n] = a, b
    c = np.zeros(n + 1)
    c[0] = model.c
    # In units in which one sample of d moves y like its noise does.
    drift = np.zeros((n + 1, n + 1))
    drift[n, n] = confidence / (float(np.linalg.norm(b)) * model.c) ** 2
    # A trace of noise on x keeps the equation regular.
    drift += 1e-12 * drift[n, n] * np.eye(n + 1)
    try:
        p = linalg.solve_discrete_are(believed.T, c[:, None], drift, np.eye(1))
    except (linalg.LinAlgError, ValueError):
        return np.inf
    correction = p @ c / (c @ p @ c + 1.0)
    feedback = np.append(gain, 0.0)
    loop = np.zeros((2 * n + 1, 2 * n + 1))
    loop[:n, :n], loop[:n, n:] = a, -factor * np.outer(b, feedback)
    predicted = believed - np.outer(np.append(b, 0.0), feedback)
    measured = np.outer(correction, c[:n])
    loop[n:, :n] = measured @ loop[:n, :n]
    loop[n:, n:] = predicted - np.outer(correction, c) @ predicted + measured @ loop[:n, n:]
    return float(np.abs(linalg.eigvals(loop)).max())
