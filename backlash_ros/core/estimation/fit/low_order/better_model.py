"""The G of low order that a fit speaks for.

A fit explains y by G (1 + Delta); a structure can only be designed for a G of low order, which
`low_order` finds in y and in the u of the fit.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit.low_order.family import Family, memory_of
from backlash_ros.core.estimation.fit.low_order.low_order import likelier_by_values, low_order
from backlash_ros.core.estimation.fit.low_order.output_error import OutputError
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.rounding.rounded_output import likelier_by_intervals
from backlash_ros.core.estimation.fit.solution import Solution
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.regression.readings import weights_of
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.model_check import check_model
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

WORTH_A_DESIGN = 1.0  # log-likelihood by which another G has to be likelier at least
FEWEST_ROWS = 300  # newest samples at least that G of low order is fitted to


def better_model(
    v: Array, y: Array, fit: WindowFit, solution: Solution, pace: Pace,
) -> Generator[None, None, StateModel | None]:
    """Return the G that fits y best, given u of this fit of v (N,) and y (N,), nan where lost.

    None where no G that may be told comes out.
    """
    problem = _problem(v, y, fit, solution, pace)
    yield
    family = Family(fit.model.transfer_function, fit.around.error, solution.posterior.scale)
    xi, delay = yield from low_order(family, problem)
    better = family.transfer_function(xi, delay, problem)
    return StateModel(better) if better is not None and _allowed(better) else None


class Refined(NamedTuple):
    """A G, and to how many samples it was fitted; 0 for one that was told."""

    model: StateModel
    samples: int


def refined_model(
    v: Array, y: Array, fit: WindowFit, solution: Solution, present: Refined, pace: Pace,
) -> Generator[None, None, Refined]:
    """Return the G that explains y best, or the present one as long as that does it as well.

    The fit itself stays around the G that it has: it knows the rest of the error as well.
    """
    error = fit.around.error
    if not solution.m > 0.0:
        return present
    begin, rounding = 0, fit.samples.rounding
    if rounding is not None:
        # Intervals are too sharp for a u that depends on where the play began.
        begin = fit.forgotten_after(v) + memory_of(fit.model.transfer_function)
        if begin > len(v) - FEWEST_ROWS:
            return present
    problem = _problem(v, y, fit, solution, pace, begin)
    yield
    family = Family(fit.model.transfer_function, error, solution.posterior.scale)
    told = present.model.transfer_function
    if rounding is not None:
        # More samples tell more; as many have to say more than chance does.
        by = WORTH_A_DESIGN if problem.samples > present.samples else float(error.count)
        read = y[len(y) - problem.samples:]
        better = yield from likelier_by_intervals(family, problem, told, read, rounding, by)
    else:
        # What no G explains is no better explained for as many coefficients.
        by = error.count * solution.inflation
        left = fit.samples.residual(solution.posterior, len(v) - problem.samples)
        least = float(left @ left) / solution.posterior.noise_std**2
        better = yield from likelier_by_values(family, problem, told, least, by)
    if better is None or not _allowed(better):
        return present
    return Refined(StateModel(better), problem.samples)


def _problem(
    v: Array, y: Array, fit: WindowFit, solution: Solution, pace: Pace, begin: int = 0,
) -> OutputError:
    model = fit.model.transfer_function
    memory, rows = memory_of(model), max(pace.pieces(fit.around.error.taps + 2), FEWEST_ROWS)
    u = np.concatenate([fit.input_before(solution, memory), fit.input(solution, v)])
    first = max(len(v) - rows, begin)
    weights = np.where(np.isfinite(y), weights_of(y), 0.0)
    return OutputError(
        model, u[first + memory:], y[first:], weights[first:], u[first:first + memory],
        solution.posterior.noise_std,
    )


def _allowed(model: TransferFunction) -> bool:
    try:
        check_model(model)
    except ParameterError:
        return False
    return True
