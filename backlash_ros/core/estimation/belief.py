"""What is believed of the backlash: the state of the estimator, its fit, and what is published."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from math import inf

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimation.explanations import Record, Setup, problem_of
from backlash_ros.core.estimation.fit import Problem
from backlash_ros.core.estimation.posterior import Fit, Prior, Start
from backlash_ros.core.estimation.settings import FIRST_FIT, LASTING

Array = NDArray[np.float64]


class State(Enum):
    """How the fit stands to the newest samples; learning.py has the table of transitions."""

    SEARCHING = auto()
    KNOWN = auto()
    DOUBTED = auto()


@dataclass(frozen=True)
class Inherited:
    """What was known before the run: m, c_r, c_l (3,) and their covariance (3, 3)."""

    crossings: Array
    cov: Array


@dataclass(frozen=True)
class Belief:
    """What is believed after the samples before `end`.

    first: number of the first sample of the record. older, start: what samples before it say.
    next_at: number of samples at which to look again, thorough_at: for other gaps too. candidate:
    found once. tried: newest fit that is not known well enough. doubt_from: sample from which on
    the fit is contradicted. predicted: samples that the fit has predicted since it was adopted.
    must_predict: how many of them before it is published. adopted_noise: of the fit as adopted.
    published, cov: of m, c_r, c_l, None while nothing was. rejected: numbers of readings
    that are outliers. swapped: numbers of the samples over which the other command acted. coasts:
    whether the load runs on within the gap.
    """

    state: State = State.SEARCHING
    reason: Status = Status.ACQUIRING
    fit: Fit | None = None
    first: int = 0
    end: int = 0
    next_at: int = FIRST_FIT
    thorough_at: int = 0
    older: Prior | None = None
    start: Start | None = None
    candidate: Fit | None = None
    tried: Fit | None = None
    doubt_from: int | None = None
    predicted: int = 0
    must_predict: int = 0
    adopted_noise: float = inf
    published: Array | None = None
    cov: Array | None = None
    inherited: Inherited | None = None
    rejected: frozenset[int] = frozenset()
    swapped: frozenset[int] = frozenset()
    coasts: bool = False

    @property
    def on_probation(self) -> bool:
        """Whether the fit follows one that was contradicted and has not held for long."""
        return self.predicted < LASTING * self.must_predict

    @property
    def trusted(self) -> bool:
        """Whether the fit explains its samples and is known well enough."""
        return self.state is State.KNOWN and self.reason is not Status.INCONSISTENT


def problem_beside(setup: Setup, record: Record, belief: Belief) -> Problem:
    """The fit of a record beside what is believed of the samples before it."""
    walk_std = belief.fit.walk_std if belief.fit is not None else 0.0
    return problem_of(setup, record, belief.older, belief.start, walk_std=walk_std)
