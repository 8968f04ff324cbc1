"""Between two fits: u_hat from the play operator, the state of G from an observer.

    p(k) = min(max(p(k-1), v), v + gap),   u_hat = m (p - c_r)
    x_hat(k+1) = A x_hat + B u_hat + k e
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.explanations import Record
from backlash_ros.core.estimation.fit import walk
from backlash_ros.core.estimation.observer import Gains, Observer
from backlash_ros.core.estimation.play import play
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.estimation.settings import GATE, OUTLIERS
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.state_model import StateModel, powers
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

REMEMBERED = 1500  # samples from which the state of a G is found, at most


class Place(NamedTuple):
    """Where play and G stand after sample `end`.

    p: of the play operator. u, y: over the newest samples (M,). x: state of
    `model` in the observer form.
    """

    end: int
    p: float
    u: Array
    y: Array
    x: Array
    model: TransferFunction


def place_of(fit: Fit, record: Record, model: TransferFunction, memory: int) -> Place:
    """Where this fit of the record says that play and this G stand after it.

    memory: of G [samples].
    """
    p = play(record.v, max(fit.gap, 0.0), fit.p0)
    count = min(len(p), 4 * memory, REMEMBERED)
    u, y = fit.m * p - fit.theta[1], record.y[-count:]
    if len(fit.knots):
        u += walk(fit.knots, len(u))
    u = u[-count:]
    return Place(record.end, float(p[-1]), u, y, state_after(model, u, y), model)


def state_after(model: TransferFunction, u: Array, y: Array) -> Array:
    """The state of this G (observer form) that explains y (M,), nan where lost, after u (M,)."""
    a, b, c = model.state_space()
    responses = powers(a, b, len(u))
    forced = np.convolve(responses @ c, u)[:len(u)]
    columns = powers(a.T, a.T @ c, len(u))  # of the state before them
    known = np.isfinite(y)
    before = np.linalg.lstsq(columns[known], (y - forced)[known], rcond=1e-12)[0]
    return np.asarray(np.linalg.matrix_power(a, len(u)) @ before + u[::-1] @ responses)


class Following:
    """Follows play operator and state of G from sample to sample.

    model: G of the structure that asks for x_hat. gains: of its observer, None where they are made
    one by one. before: gives x_hat until a backlash is known. u: before the newest y; nan before a
    backlash is known. innovation: of the newest y. since_motion: samples since p, or v before a
    backlash is known, moved. outliers: readings that did not move the state. surprised: whether so
    many in a row were beyond the gate that they are none.
    """

    def __init__(self, model: StateModel, before: FixedBacklash | None) -> None:
        self.model = model
        self.gains: Gains | None = None
        self.u = self.innovation = nan
        self.since_motion = self.outliers = 0
        self.surprised = False
        self._before = before
        self._observer: Observer | None = None
        self._p = self._v = nan
        self._beyond = 0  # readings in a row beyond the gate
        self._u: deque[float] = deque(maxlen=REMEMBERED)  # over the newest samples
        self._y: deque[float] = deque(maxlen=REMEMBERED)

    @property
    def begun(self) -> bool:
        """Whether a backlash is known by which to follow."""
        return self._observer is not None

    @property
    def x_hat(self) -> list[float]:
        """State of G in the coordinates of `model`, n values."""
        if self._observer is not None:
            return self._observer.state
        if self._before is not None:
            state: list[float] = self._before.x_hat.tolist()
            return state
        return [0.0] * self.model.order

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None before a backlash is known."""
        return self._observer.cov if self._observer is not None else None

    def change_model(self, model: StateModel, gains: Gains | None) -> None:
        """Give x_hat for this G from now on; gains: of its observer."""
        self.model, self.gains = model, gains
        if self._before is not None:
            self._before = self._before.with_model(model)
        if self._observer is not None:
            before = self._observer
            self._observer = Observer(model, before.noise_std, before, gains)
            y = np.array(self._y)
            if np.isfinite(y).sum() > model.order:
                x = state_after(model.transfer_function, np.array(self._u), y)
                self._observer.place(x, True)

    def is_of(self, place: Place) -> bool:
        """Whether a place is one of this G."""
        own, of = self.model.transfer_function, place.model
        return of is own or (
            np.array_equal(of.denominator, own.denominator)
            and np.array_equal(of.numerator, own.numerator)
        )

    def settle(self, noise_std: float) -> None:
        """Let the gain of the observer adapt where no fit says where the state is."""
        if self._observer is not None:
            self._observer.settle(noise_std)

    def step(self, y: float | None, interval: Interval, estimate: Estimate) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        v, observer = interval.v, self._observer
        if observer is None:
            self.since_motion = self.since_motion + 1 if v == self._v else 0
            self._v = v
            if self._before is not None:
                self._before.update(y, interval)
            return
        p = clamp(self._p, v, v + estimate.c_r - estimate.c_l)
        self.since_motion = self.since_motion + 1 if p == self._p else 0
        self._p = p
        self.u = u = estimate.m * (p - estimate.c_r)
        self._u.append(u)
        self._y.append(nan if y is None else y)
        self._correct(observer, y, observer.predict(u))

    def _correct(self, observer: Observer, y: float | None, expected: float) -> None:
        self.surprised = False
        if y is None:
            self.innovation = nan
            return
        self.innovation = innovation = y - expected
        if innovation * innovation <= GATE**2 * observer.variance:
            self._beyond = 0
            observer.correct(innovation)
            return
        self._beyond += 1
        if self._beyond < OUTLIERS:
            self.outliers += 1
            return
        # So many in a row are none: the state goes on with them.
        self.surprised = self._beyond == OUTLIERS
        observer.correct(innovation)

    def go_on_from(
        self, place: Place, newer: Sequence[tuple[float, float]], estimate: Estimate,
        noise_std: float, known: bool,
    ) -> None:
        """Let play and observer stand where a fit says that they stood, and step to now.

        newer: v and y of the samples since then. known: whether the fit explains all of its
        samples, so that it knows the state better than the newest of them do.
        """
        observer = self._observer
        if observer is None:
            observer = self._observer = Observer(self.model, noise_std, None, self.gains)
        else:
            observer.settle(noise_std)
        gap = estimate.c_r - estimate.c_l
        p = place.p
        self._u.clear()
        self._y.clear()
        self._u.extend(place.u.tolist())
        self._y.extend(place.y.tolist())
        follows = self.is_of(place)
        if follows:
            observer.place(place.x, known)
        for v, y in newer:
            p = clamp(p, v, v + gap)
            u = estimate.m * (p - estimate.c_r)
            self._u.append(u)
            self._y.append(y)
            if follows:
                innovation = y - observer.predict(u)
                if innovation * innovation <= GATE**2 * observer.variance:  # not where y was lost
                    observer.correct(innovation)
        self._p, self.u = p, estimate.m * (p - estimate.c_r)
