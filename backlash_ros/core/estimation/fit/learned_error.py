"""What a fit says of the error of G: how large it is, and whether it is more than chance."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import BY_CHANCE, LINEAR
from backlash_ros.core.estimation.fit.solution import Solution
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]


def response_std(
    fit: WindowFit, solution: Solution, model: StateModel, z: NDArray[np.complex128],
) -> Array:
    """Relative deviation of the response of the true G from that of `model` at z (M,), shape (M,).

    The root of the mean of |dG/G|^2 over the posterior of the error of G and of the leak of its
    integrator. What is known of the error counts as far as `model` goes without it. The gain
    at rest is part of m. 0 where G is exact.
    """
    layout, posterior = fit.layout, solution.posterior
    error, m = fit.around.error, solution.m
    part = slice(layout.base, layout.base + layout.errors)
    by: NDArray[np.complex128] = np.zeros((len(z), layout.unknowns), dtype=np.complex128)
    if m != 0.0:
        by[:, part] = error.responses(z) @ error.spread / m
    if layout.leak:
        by[:, layout.driven] = -1.0 / (z - 1.0)
    known = by @ posterior.mean
    if m != 0.0:
        by[:, layout.n + 1] = -(by[:, part] @ posterior.mean[part]) / m
    variance = np.einsum('mp,pq,mq->m', by, posterior.cov, by.conj()).real
    spread = posterior.noise_std**2 * solution.inflation
    of_fit, given = (one.transfer_function.response(z) for one in (fit.model, model))
    left = np.abs(known + (of_fit - given) / of_fit) ** 2 + np.maximum(variance, 0.0) * spread
    return np.asarray(np.sqrt(left) * np.abs(of_fit / given))


def plausible(fit: WindowFit, solution: Solution) -> bool:
    """Whether the error of G is one that its prior with the largest scale expects."""
    layout, most = fit.layout, fit.around.most
    if layout.errors == 0 or most == inf:
        return True
    error = solution.posterior.mean[layout.base:layout.base + layout.errors]
    size = float(error @ error) / (most * solution.m) ** 2 if most > 0.0 else 0.0
    return size <= BY_CHANCE**2 * layout.errors


def wants_another_model(fit: WindowFit, solution: Solution) -> bool:
    """Whether the error of G is more than chance: then a G of low order may take it over.

    But where G was identified with the backlash, its uncertainty was measured: what is far beyond
    that is no error of G.
    """
    layout, posterior = fit.layout, solution.posterior
    if posterior.scale < LINEAR or (fit.around.inherited and posterior.scale > BY_CHANCE):
        return False
    part = slice(layout.base, layout.base + layout.errors)
    spread = posterior.noise_std**2 * solution.inflation
    error, cov = posterior.mean[part], posterior.cov[part, part] * spread
    return float(error @ np.linalg.pinv(cov) @ error) > 2.0 * layout.errors
