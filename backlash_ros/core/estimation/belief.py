"""The state of the estimator, and how old samples are dropped but not forgotten."""

from dataclasses import replace
from enum import Enum, auto
from math import inf, nan, sqrt
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.explanations import Setup
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.backlash import Region, engaged, reversals
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window


class State(Enum):
    """How the fit relates to the newest samples; state_machine.py has the table of transitions."""

    SEARCHING = auto()
    KNOWN = auto()
    DOUBTED = auto()


class Known(NamedTuple):
    """m, c_r, c_l (3,) and their covariance (3, 3)."""

    crossings: Array
    cov: Array


class Kept(NamedTuple):
    """What is kept of the samples: those from `first` on, and the information in older ones."""

    first: int = 0
    older: Prior | None = None
    rejected: frozenset[int] = frozenset()  # samples whose reading is an outlier
    swapped: frozenset[int] = frozenset()  # samples in whose interval the other v acted


class Trial(NamedTuple):
    """Samples that a fit must predict to be published, samples it has predicted, initial noise."""

    must: int = 0
    predicted: int = 0
    noise: float = inf


class Belief(NamedTuple):
    """What is believed after the samples before `end`."""

    fit: WindowFit | None = None
    found: WindowFit | None = None  # newest candidate, not adopted so far
    doubt_from: int | None = None  # first sample that contradicts the fit
    end: int = 0
    next_at: int = settings.FIRST_FIT  # sample at which the next fit is due
    thorough: tuple[int, float] = 0, 0.0  # when a thorough fit is due: sample, cov[2, 2]
    kept: Kept = Kept()
    trial: Trial = Trial()
    published: Known | None = None
    inherited: Known | None = None  # estimate from before the run
    reason: Status = Status.ACQUIRING  # status of what is published
    coasts: bool = False  # whether the load coasts in the gap
    holds: bool = False  # whether what is published explains the samples that the fit does not

    @property
    def state(self) -> State:
        if self.fit is None:
            return State.SEARCHING
        return State.KNOWN if self.doubt_from is None else State.DOUBTED

    @property
    def trusted(self) -> bool:
        """Whether the fit explains its samples and is known well enough."""
        return self.state is State.KNOWN and self.reason is not Status.INCONSISTENT


def shortened(
    setup: Setup, record: Window, problem: Problem, belief: Belief, fit: WindowFit,
) -> tuple[Belief, WindowFit]:
    """Drop the oldest samples once the others suffice; what they say of theta stays as a prior."""
    count, kept, cut, run = len(record.v), belief.kept, 0, problem.at(fit)
    drift = setup.drift**2 * count / 3.0
    if count >= settings.LONGEST or (
            count > 4 * settings.PREDICTED and (drift > np.diag(fit.crossings_cov)).any()):
        cut = count // 3
    elif count >= settings.ROWS:
        turns = reversals(engaged(run.v, run.p, fit.gap))
        if len(turns) > settings.HELD_REVERSALS:
            cut = min(count // 3, int(turns[-settings.HELD_REVERSALS]) - 1)
    if cut < count // 6:
        return belief, fit
    rest = record.between(record.first + cut)
    p = run.p[:cut]
    side = engaged(run.v[:cut], p, fit.gap)[-1]
    left = bool(side == Region.LEFT)
    v = nan if side == Region.GAP else float(p[-1] - fit.gap if left else p[-1])
    begin = replace(fit, p0=float(p[-1]), x=np.zeros(len(fit.x)), knots=np.zeros(0))
    older = _aged(setup, fit, problem.remembered(fit, cut), cut)
    # Beside an inherited estimate they are not needed, and linearized far from it they mislead.
    for beside in (*[older._replace(v=v, left=left)] * (belief.inherited is None), None):
        problem = setup.problem(rest, beside)
        shorter = problem.finished(problem.fitted(problem.begun(begin)))
        if shorter.left.rms < 2.0 * fit.left.rms:
            break
    rejected, swapped = (frozenset(k for k in numbers if k >= rest.first)
                         for numbers in (kept.rejected, kept.swapped))
    return belief._replace(kept=Kept(rest.first, beside, rejected, swapped)), shorter


def _aged(setup: Setup, fit: WindowFit, prior: Prior, samples: int) -> Prior:
    """The prior, discounted for correlated residuals, widened by other gaps, drift and walk."""
    discount = sqrt(fit.left.dispersion / fit.inflation)  # cov is inflated by dispersion later on
    rows, values = discount * prior.rows, discount * prior.values
    wider = np.diag(np.append(setup.drift**2 * samples, np.zeros(len(fit.theta) - 3)))
    if fit.gap_std**2 > 2.0 * fit.inflation * fit.cov[2, 2]:  # far from normal
        wider += fit.spread
    if wider.any():
        try:
            cov = np.linalg.inv(rows.T @ rows)
        except np.linalg.LinAlgError:
            return Prior(rows[:0], values[:0])
        (m, c_r, _), by = fit.crossings, np.eye(len(wider))
        by[:3, :3] = [[1.0, 0.0, 0.0], [c_r, m, 0.0], [0.0, 1.0, -1.0]]  # Jacobian of m, o, g
        theta = np.linalg.lstsq(rows, values, rcond=None)[0]
        cov += by @ wider @ by.T
        rows = np.linalg.inv(np.linalg.cholesky(cov))
        values = rows @ theta
    if fit.walk_std:  # o has walked since: marginalize it
        both = np.column_stack([rows[:, 1], np.delete(rows, 1, axis=1), values])
        r = np.asarray(np.linalg.qr(both, mode='r'))[1:]
        rows, values = np.insert(r[:, 1:-1], 1, 0.0, axis=1), r[:, -1]
    return Prior(rows, values)
