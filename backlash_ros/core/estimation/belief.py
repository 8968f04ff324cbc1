"""What is believed of the backlash, and what older samples leave of it."""

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
    """How the fit stands to the newest samples; state_machine.py has the table of transitions."""

    SEARCHING = auto()
    KNOWN = auto()
    DOUBTED = auto()


class Known(NamedTuple):
    """m, c_r, c_l (3,) and their covariance (3, 3)."""

    crossings: Array
    cov: Array


class Kept(NamedTuple):
    """What is kept of the samples: those from number `first` on, and what the older ones say."""

    first: int = 0
    older: Prior | None = None
    rejected: frozenset[int] = frozenset()  # numbers of readings that are outliers
    swapped: frozenset[int] = frozenset()  # of samples over which the other command acted


class Trial(NamedTuple):
    """Samples that a fit must predict before it is published, and has; its noise when adopted."""

    must: int = 0
    predicted: int = 0
    noise: float = inf


class Belief(NamedTuple):
    """What is believed after the samples before `end`."""

    fit: WindowFit | None = None
    found: WindowFit | None = None  # the newest that is not adopted
    doubt_from: int | None = None  # sample from which on the fit is contradicted
    end: int = 0
    next_at: int = settings.FIRST_FIT  # number of samples at which to look again
    thorough: tuple[int, float] = 0, 0.0  # the same for other gaps, or deviation of this one
    kept: Kept = Kept()
    trial: Trial = Trial()
    published: Known | None = None
    inherited: Known | None = None  # before the run
    reason: Status = Status.ACQUIRING  # of what is published
    coasts: bool = False  # whether the load runs on within the gap

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
    """Let the oldest samples go, but for what they say of theta, once the others hold enough."""
    count, kept, cut = len(record.v), belief.kept, 0
    drift = setup.drift**2 * count / 3.0
    if count >= settings.LONGEST or (
            count > 4 * settings.PREDICTED and (drift > np.diag(fit.crossings_cov)).any()):
        cut = count // 3
    elif count >= settings.ROWS:
        turns = reversals(engaged(record.v, problem.at(fit).p, fit.gap))
        if len(turns) > settings.HELD_REVERSALS:
            cut = min(count // 3, int(turns[-settings.HELD_REVERSALS]) - 1)
    if cut < count // 6:
        return belief, fit
    rest = record.between(record.first + cut)
    old = setup.problem(record.between(record.first, rest.first), kept.older)
    p = old.at(fit).p
    side = engaged(old.v, p, fit.gap)[-1]
    left = bool(side == Region.LEFT)
    v = nan if side == Region.GAP else float(p[-1] - fit.gap if left else p[-1])
    begin = replace(fit, p0=float(p[-1]), x=np.zeros(len(fit.x)), knots=np.zeros(0))
    older = _aged(setup, fit, old.remembered(replace(fit, knots=begin.knots)), cut)
    for beside in (older._replace(v=v, left=left), None):
        problem = setup.problem(rest, beside)
        shorter = problem.finished(problem.fitted(problem.begun(begin)))
        if shorter.left.rms < 2.0 * fit.left.rms:
            break
    rejected, swapped = (frozenset(k for k in numbers if k >= rest.first)
                         for numbers in (kept.rejected, kept.swapped))
    return belief._replace(kept=Kept(rest.first, beside, rejected, swapped)), shorter


def _aged(setup: Setup, fit: WindowFit, prior: Prior, samples: int) -> Prior:
    """What is left of a prior after so many samples of drift and walk."""
    discount = sqrt(fit.left.dispersion / fit.inflation)  # a dispersion counts once, in the end
    rows, values = discount * prior.rows, discount * prior.values
    if setup.drift.any():
        try:
            cov = np.linalg.inv(rows.T @ rows)
        except np.linalg.LinAlgError:
            return Prior(rows[:0], values[:0])
        m, c_r, _ = fit.crossings
        by = np.array([[1.0, 0.0, 0.0], [c_r, m, 0.0], [0.0, 1.0, -1.0]])  # of m, o, g
        theta = np.linalg.lstsq(rows, values, rcond=None)[0]
        cov[:3, :3] += by @ np.diag(setup.drift**2 * samples) @ by.T
        rows = np.linalg.inv(np.linalg.cholesky(cov))
        values = rows @ theta
    if fit.walk_std:  # o has walked on since
        both = np.column_stack([rows[:, 1], np.delete(rows, 1, axis=1), values])
        r = np.asarray(np.linalg.qr(both, mode='r'))[1:]
        rows, values = np.insert(r[:, 1:-1], 1, 0.0, axis=1), r[:, -1]
    return Prior(rows, values)
