"""The G of low order that fits a record best, given u: Gauss-Newton steps on the output error."""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import STANDS
from backlash_ros.core.estimation.fit.low_order.family import SHIFTS, Family
from backlash_ros.core.estimation.fit.low_order.output_error import OutputError
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

GAUSS_NEWTON_STEPS = 10  # Gauss-Newton steps, those that were too long included
SHORTER = 0.3  # share of a step that is tried where the whole step leads uphill


def low_order(
    family: Family, problem: OutputError, shifts: Sequence[int] = SHIFTS,
) -> Generator[None, None, tuple[Array, int]]:
    """Fit G, beginning with the told one; its xi, and its delay in samples.

    shifts: samples of delay more than the told one has that are compared. Yields between pieces.
    """
    cost, delay = np.inf, family.model.delay
    best = family.told
    for shift in shifts:
        if family.model.delay + shift >= 1:
            fit = yield from _fit(family, family.model.delay + shift, problem)
            if fit[0] < cost:
                cost, best = fit
                delay = family.model.delay + shift
    return best, delay


def likelier_by_values(
    family: Family, problem: OutputError, present: TransferFunction, least: float, by: float,
) -> Generator[None, None, TransferFunction | None]:
    """The best G of the family, None unless it is likelier than the present one.

    least: twice the negative log-likelihood of the fit with all its error terms; where the present
    G is hardly less likely, no other one is looked for. by: log-likelihood that counts as more.
    """
    misfit = problem.misfit(present)
    if misfit <= least + 2.0 * by:
        return None
    xi, delay = yield from low_order(family, problem, shifts=(0,))
    better = family.transfer_function(xi, delay, problem)
    return better if better is not None and problem.misfit(better) + 2.0 * by < misfit else None


def _fit(
    family: Family, delay: int, problem: OutputError,
) -> Generator[None, None, tuple[float, Array]]:
    """Cost and xi."""
    xi = step = family.told
    best = (np.inf, xi)
    length = 1.0
    for _ in range(GAUSS_NEWTON_STEPS):
        trial = xi + length * step
        cost = np.inf
        coefficients = family.coefficients(trial)
        if coefficients is not None:
            b, a = coefficients
            poles = problem.poles(a)
            free, answer = problem.free_responses(poles), problem.response(b, poles, delay)
            residual = problem.residual(answer, free)
            cost = float(residual @ residual) + float(trial @ trial)
        if not cost < best[0]:
            length *= SHORTER
            continue
        xi, length, best = trial, 1.0, (cost, trial)
        slopes = problem.slopes(a, answer, delay, family.taps, free)
        rows = np.concatenate([slopes.T @ family.prior, np.eye(len(xi))])
        step = np.linalg.lstsq(rows, np.append(residual, -xi), rcond=None)[0]
        if np.linalg.norm(rows @ step) <= STANDS:
            break
        yield
    return best
