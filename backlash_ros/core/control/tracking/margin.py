"""How far feedback is from instability where the slope of the backlash, or G, is another one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.numerics import riccati
from backlash_ros.core.plant.transfer_function import StateModel

Array = NDArray[np.float64]

# Variance of the disturbance per sample, seen in y, over that of the noise on y: from an observer
# that believes its model to one that believes y alone.
CONFIDENCES = (1e-4, 1e-1, 1e2, 1e5)


@dataclass(frozen=True)
class Feedback:
    """u = -gain x_hat - integral q, x_hat from an observer that believes `model`.

    The observer is one of [x; d] as in FixedBacklash, d being a slow disturbance of u, and
    q(k+1) = q(k) - y(k). gain: shape (n,).
    """

    model: StateModel
    gain: Array
    integral: float = 0.0


def tolerates(feedback: Feedback, factor: float) -> bool:
    """Whether feedback keeps its G stable although u acts `factor` times as strongly.

    The observer does not know of the factor. The gap itself is left out: it limits what u can do
    wrong, but not for ever.
    """
    return all(_is_stable(feedback.model, feedback, each, factor) for each in CONFIDENCES)


def modulus_margin(plant: StateModel, feedback: Feedback) -> float:
    """Distance of the open loop L from -1, min |1 + L| over all frequencies.

    For the worst of the observers; 0 where the loop is unstable with one of them.
    """
    if not all(_is_stable(plant, feedback, each) for each in CONFIDENCES):
        return 0.0
    return min(_distance(plant, feedback, each) for each in CONFIDENCES)


def _is_stable(
    plant: StateModel, feedback: Feedback, confidence: float, factor: float = 1.0,
) -> bool:
    """Whether the loop with the state [x of the plant; x_hat; d_hat; q] is stable."""
    correction = _correction(feedback.model, confidence)
    if correction is None:
        return False
    n = plant.order
    believed, drive, seen = _believed(feedback.model)
    size = n + len(drive) + 1
    gain = np.zeros(size)
    gain[n:-2], gain[-1] = feedback.gain, feedback.integral
    loop = np.zeros((size, size))
    loop[:n, :n] = plant.a
    loop[:n] -= factor * np.outer(plant.b, gain)
    # x_hat(k+1) = prediction + correction (y(k+1) - its prediction)
    loop[n:-1, n:-1] = believed
    loop[n:-1] -= np.outer(drive, gain)
    loop[n:-1] += np.outer(correction, plant.c * loop[0] - seen @ loop[n:-1])
    if feedback.integral:
        loop[-1, 0], loop[-1, -1] = -plant.c, 1.0
    return bool(np.abs(np.linalg.eigvals(loop)).max() < 1.0)


def _distance(plant: StateModel, feedback: Feedback, confidence: float) -> float:
    """Least |1 + L| of a stable loop, opened at u."""
    correction = _correction(feedback.model, confidence)
    assert correction is not None
    believed, drive, seen = _believed(feedback.model)
    gain = np.append(feedback.gain, 0.0)
    closed = believed - np.outer(drive, gain)
    closed -= np.outer(correction, seen @ closed)
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 120))
    at = z[:, None, None]
    x_hat = np.linalg.solve(at * np.eye(len(gain)) - closed, at * correction[:, None])
    minus_u = (gain @ x_hat)[:, 0] - feedback.integral / (z - 1.0)
    return float(np.abs(1.0 + plant.transfer_function.response(z) * minus_u).min())


def _believed(model: StateModel) -> tuple[Array, Array, Array]:
    """Transition, input and output of [x; d]."""
    n = model.order
    a, b, c = np.eye(n + 1), np.append(model.b, 0.0), np.zeros(n + 1)
    a[:n, :n], a[:n, n], c[0] = model.a, model.b, model.c
    return a, b, c


@lru_cache(maxsize=16)
def _correction(model: StateModel, confidence: float) -> Array | None:
    """Gain of the observer of [x; d], shape (n + 1,); None where none exists."""
    a, _, c = _believed(model)
    # In units in which one sample of d moves y like its noise does; a trace of noise on x keeps
    # the equation regular.
    drift = 1e-12 * np.eye(len(c))
    drift[-1, -1] += 1.0
    drift *= confidence / (float(np.linalg.norm(model.b)) * model.c) ** 2
    try:
        p = riccati(a.T, c, drift)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(p @ c / (c @ p @ c + 1.0))
