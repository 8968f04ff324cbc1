"""What a fit says of the error of G: how large it is, and whether it is more than chance."""

from __future__ import annotations

from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import AS_GOOD, BY_CHANCE, LINEAR
from backlash_ros.core.estimation.fit.prior import beyond_chance
from backlash_ros.core.estimation.fit.solution import Solution
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.regression.error_model import TAPS, ErrorModel
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.model_check import check_model
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

WORTH_A_DESIGN = 1.0  # log-likelihood by which another G has to be likelier at least
# --- guards
TINY = 1e-300  # deviation of the noise where there is none


def error_of(fit: WindowFit, solution: Solution) -> tuple[Array, Array]:
    """xi of the true G, beside the G of the fit: mean (K,) and covariance (K, K). For m > 0."""
    part, posterior, m = fit.layout.error, solution.posterior, solution.m
    noise = posterior.noise_std / m  # whose square is a number, unlike that of any m
    cov = posterior.cov[part, part] * (noise * noise * solution.inflation)
    return fit.around.error.told + posterior.mean[part] / m, cov


def strayed(fit: WindowFit, solution: Solution) -> bool:
    """Whether the samples tell poles of G for which first order around the fit is not enough."""
    xi = _told_by_samples(fit, solution)
    return xi is not None and _beyond_first_order(fit, solution, xi)


def _beyond_first_order(fit: WindowFit, solution: Solution, xi: Array) -> bool:
    poles = fit.around.error.uncertainty * float(np.abs(xi[TAPS:]).max(initial=0.0))
    return poles * _shows(fit, solution, xi) > LINEAR


def _shows(fit: WindowFit, solution: Solution, xi: Array) -> float:
    """Norm of what xi (K,) makes of all outputs, in deviations of the noise."""
    moved = fit.samples.triangle.r[:-1, fit.layout.error] @ (xi * solution.m)
    return float(np.linalg.norm(moved)) / max(solution.posterior.noise_std, TINY)


def moved_error(fit: WindowFit, solution: Solution, share: float = 1.0) -> ErrorModel:
    """The error model around the G that the fit speaks for; the same one where that is near.

    share: of the way to its poles.
    """
    error, xi = fit.around.error, _told_by_samples(fit, solution)
    if xi is None:
        return error
    # Poles are looked for around the right delay: slower ones may pass for it.
    later = error.delayed(xi) if share == 1.0 else error
    if later is not error or not _beyond_first_order(fit, solution, xi):
        return later
    return error.moved(share * xi)


def _told_by_samples(fit: WindowFit, solution: Solution) -> Array | None:
    """xi (K,) where the samples tell another G than that of the fit, beside what no G explains.

    One that was identified with the backlash stays: it is that of this very motion.
    """
    if not fit.layout.errors or fit.around.inherited or not solution.m > 0.0:
        return None
    xi, cov = error_of(fit, solution)
    tells = bool(xi.any()) and float(xi @ np.linalg.solve(cov, xi)) > 2.0 * len(xi)
    return xi if tells else None


class Learned(NamedTuple):
    """A G of low order, and its xi beside the one that was told: mean (K,), covariance (K, K).

    log_det: of that covariance, were the noise and what nothing explains 1; inf as long as nothing
    was learned.
    """

    model: StateModel
    xi: Array
    cov: Array
    log_det: float


def as_told(model: StateModel, count: int) -> Learned:
    """The G that was told, with `count` xi."""
    return Learned(model, np.zeros(count), np.zeros((count, count)), inf)


def likelier(fit: WindowFit, solution: Solution, present: Learned) -> Learned:
    """The G that the fit speaks for, unless the present one explains the samples as well.

    A record that tells less of G than the one before has to contradict it: by more than chance, and
    than the errors of a sensor that come again with the motion.
    """
    layout, error = fit.layout, fit.around.error
    if not solution.m > 0.0 or not error.count:
        return present
    xi, cov = error_of(fit, solution)
    if not cov.any():
        return present  # without doubt as told
    apart = xi - error.told - present.xi
    part = layout.error
    log_det = float(np.linalg.slogdet(solution.posterior.cov[part, part] / solution.m**2)[1])
    if log_det < present.log_det:
        another = 0.5 * float(apart @ np.linalg.solve(cov, apart)) > WORTH_A_DESIGN
    else:
        left = hypot(1.0, _shows(fit, solution, apart) / sqrt(solution.count))
        another = left > AS_GOOD and beyond_chance(apart, cov + present.cov)
    model = low_order(fit, solution) if another else fit.model
    if model is fit.model:
        return present
    return Learned(model, xi - error.told, cov, log_det)


def low_order(fit: WindowFit, solution: Solution) -> StateModel:
    """The G of low order that the fit speaks for, or that of the fit where there is none."""
    error = fit.around.error
    if not error.count or not solution.m > 0.0:
        return fit.model
    model = error.low_order(error_of(fit, solution)[0])
    return fit.model if model is None or not _allowed(model) else StateModel(model)


def _allowed(model: TransferFunction) -> bool:
    try:
        check_model(model)
    except ParameterError:
        return False
    return True


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
    part = layout.error
    by: NDArray[np.complex128] = np.zeros((len(z), layout.unknowns), dtype=np.complex128)
    responses = error.responses(z)
    if m != 0.0:
        by[:, part] = responses / m
    if layout.leak:
        by[:, layout.driven] = -1.0 / (z - 1.0)
    known = by @ posterior.mean + responses @ error.told
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
    error = solution.posterior.mean[layout.error]
    size = float(error @ error) / (most * solution.m) ** 2 if most > 0.0 else 0.0
    return size <= BY_CHANCE**2 * layout.errors
