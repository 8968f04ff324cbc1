"""Between two fits: u_hat from the play operator, the state of G from an observer.

    p(k) = clamp(p(k-1), v, v + gap),   u_hat = m (p - c_r),   x_hat(k+1) = A x_hat + B u_hat + k e

Here it is also judged which y are outliers, and which of two commands acted.
"""

from __future__ import annotations

from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.constants import GATE, OUTLIERS
from backlash_ros.core.estimation.fit.record import Record
from backlash_ros.core.estimation.fit.relabelling import Fitted
from backlash_ros.core.estimation.observer.attribution import Attribution
from backlash_ros.core.estimation.observer.observer import Observer
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """What is to be recorded: v that acted, y after it (None: lost), v that may have acted."""

    v: float
    y: float | None
    other: float


class StateFollowing:
    """Follows play operator and state of G from sample to sample.

    model: G of the structure that asks for x_hat. before: gives it until the backlash is known. u:
    before the newest y; nan before a backlash is known. innovation: of the newest y.
    since_motion: samples since the play output, or v before there is one, moved. outliers: so far.
    reattributed: intervals over which another v acted than was said.
    """

    def __init__(self, model: StateModel, before: FixedBacklash | None) -> None:
        self.model = model
        self.u = self.innovation = nan
        self.since_motion = self.outliers = self.reattributed = 0
        self._before = before
        self._unknown = [0.0] * model.order
        self._observer: Observer | None = None
        self._attribution: Attribution | None = None  # of this observer
        self._p = self._v = nan
        self._learned = self._explains = False  # whether `model` is a G that was learned
        self._refused: list[int] = []  # numbers of the newest samples, one after the other

    @property
    def begun(self) -> bool:
        """Whether a backlash is known by which to follow."""
        return self._observer is not None

    @property
    def x_hat(self) -> list[float]:
        """State of G in the coordinates of `model`, n values."""
        if self._observer is not None:
            return self._observer.state
        return self._before.x_hat.tolist() if self._before is not None else self._unknown

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None while no fit gives it."""
        return self._observer.cov if self._observer is not None else None

    def start_of(self, estimate: Estimate) -> Start:
        """Where the play operator of this estimate stands."""
        return Start(estimate.c_r - estimate.c_l, self._p)

    def change_model(self, model: StateModel) -> None:
        """Give x_hat for this G, from the next `follow` on where a backlash is known."""
        self.model, self._learned = model, True
        self._unknown = [0.0] * model.order
        if self._before is not None:
            self._before = self._before.with_model(model)

    def settle(self, noise_std: float) -> None:
        """Let the gain of the observer adapt where no fit says where the state is."""
        if self._observer is not None:
            self._observer.settle(noise_std)

    def step(
        self, y: float | None, interval: Interval, estimate: Estimate, record: Record,
    ) -> Sample:
        """Take in y(k), None if it was lost, and v of the interval before it.

        record: of the samples before, in which an older v may turn out to have been another one.
        """
        v, _, _, _, other = interval
        observer = self._observer
        if observer is None:
            self.since_motion = self.since_motion + 1 if v == self._v else 0
            if self._before is not None:
                self._before.update(y, interval)
            self._v = v
            return Sample(v, y, other)
        gap = estimate.c_r - estimate.c_l
        p = clamp(self._p, v, v + gap)
        self.since_motion = self.since_motion + 1 if p == self._p else 0
        attribution, there = self._attribution, p
        # An observer of a G that is known to be another one would blame the commands.
        if attribution is None and other == other and self._explains:
            attribution = self._attribution = Attribution(observer)
        if attribution is not None:
            if other == other:
                there = clamp(self._p, other, other + gap)
            attribution.note(estimate.m * (there - p))
        self._p = p
        self.u = u = estimate.m * (p - estimate.c_r)
        expected = observer.predict(u)
        accepted = y
        if y is None:
            self.innovation = nan
        else:
            innovation = y - expected
            if attribution is not None:
                explained, found = attribution.judge(innovation)
                innovation -= explained
                self.reattributed += len(found)
                for ago in found:
                    if ago > 0:
                        record.exchange(record.end - ago)
                    else:
                        v, other = other, v
                        self._p, self.u = there, estimate.m * (there - estimate.c_r)
            self.innovation = innovation
            if innovation * innovation > GATE**2 * observer.variance:
                if self._refuses(y, record):
                    accepted = None
            elif self._refused:
                self._refused.clear()
            if accepted is not None:
                observer.correct(innovation)
        self._v = v
        return Sample(v, accepted, other)

    def _refuses(self, y: float, record: Record) -> bool:
        """Whether a y that is far from what was expected is an outlier."""
        if len(self._refused) < OUTLIERS:
            self._refused.append(record.end)
            record.doubt(record.end, y)
            self.outliers += 1
            return True
        # So many in a row were none: they are what the fit has to explain.
        record.restore(self._refused)
        return False

    def follow(
        self, current: Fitted, estimate: Estimate, record: Record, learned: StateModel,
    ) -> None:
        """Let play operator and observer stand where the fit says that the plant stands.

        current: fit of the first samples of the record. estimate: what is published of it. learned:
        the G that goes with it.
        """
        fit, solution, _ = current
        gap = estimate.c_r - estimate.c_l
        waiting = record.since(record.first + fit.length)[0].tolist()
        noise = solution.posterior.noise_std
        exact, cov = None, None
        of_fit = fit.model is self.model
        self._explains = self._learned or of_fit or learned is self.model
        if of_fit:
            exact, cov = fit.state(solution)
        if not self._explains:
            self._attribution = None
        observer = self._observer
        if observer is None or observer.model is not self.model:
            observer = self._observer = Observer(self.model, noise, observer)
            self._attribution = None
            if exact is None:
                exact = self._replayed(current, record)
        else:
            observer.settle(noise)
            if exact is None or cov is None or cov.trace() > observer.noise_cov.trace():
                exact = None
        p = fit.play_output(gap, solution)
        if exact is not None:
            observer.start(exact, cov)
        for v in waiting:
            p = clamp(p, v, v + gap)
            if exact is not None:
                observer.predict(estimate.m * (p - estimate.c_r))
        self._p, self.u = p, estimate.m * (p - estimate.c_r)

    def _replayed(self, current: Fitted, record: Record) -> Array:
        """State of a G that is not the one of the fit, from the samples of the fit."""
        fit, solution, _ = current
        v, y = record.since(record.first)
        v, y = v[:fit.length], y[:fit.length]
        u = fit.input(solution, v)
        observer = Observer(self.model, solution.posterior.noise_std, self._observer)
        for value, measured in zip(u.tolist(), y.tolist(), strict=True):
            expected = observer.predict(value)
            if measured == measured:
                observer.correct(measured - expected)
        return np.array(observer.state)
