"""Between fits: u from the play operator, the state of G from an observer with constant gain.

    x(k+1) = A (x(k) + l (y(k) - c x_0(k))) + b u(k)

in the coordinates of StateModel, with the gain l of a stationary Kalman filter: the white noise on
u is assumed to be just large enough to explain the innovations (R. K. Mehra, IEEE Trans. Automatic
Control 15 (1970) 175-184).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import isnan, nan
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.settings import GATE, OUTLIERS, ROWS
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.plant.backlash import clamp, play
from backlash_ros.core.plant.numerics import RATIOS, Gain, dot, gain_of, state_after
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction


class Observer:
    """Kalman observer of the state of G. before: the observer it replaces, of another G.

    gains: `gains_of` this G, or (). state: (n,). variance: of the innovation. cov: of the state.
    """

    def __init__(
        self, model: StateModel, noise_std: float, gains: Sequence[Gain],
        before: Observer | None = None,
    ) -> None:
        # A new G should not leave larger innovations than the one before.
        highest = len(RATIOS) if before is None else before.level
        self._model, self._gains = model, gains
        self._set_level(min(len(RATIOS) // 2, highest), noise_std)
        self.variance = (self._gain.innovation * noise_std) ** 2
        self._rows, self._b = model.a.tolist(), model.b.tolist()
        self.state, self._ahead = [0.0] * model.order, list[float]()  # A state, [] until computed

    def _set_level(self, level: int, noise_std: float) -> None:
        self.level, self.noise_std = level, noise_std
        self._gain = self._gains[level] if self._gains else gain_of(self._model, RATIOS[level])
        self.cov = self._gain.cov * noise_std**2

    def place(self, x: Array, known: bool) -> None:
        """Set the state (in observer form); if it is `known`, continue with the smallest gain."""
        self.state, self._ahead = (self._model.to_state @ x).tolist(), []
        if known:
            self._set_level(0, self.noise_std)

    def prepare(self) -> None:
        """Compute what the next prediction need not wait for."""
        self._ahead = self._ahead or [dot(row, self.state) for row in self._rows]

    def predict(self, u: float) -> float:
        """Advance the state by one period with this u; return the predicted y."""
        self.prepare()
        self.state, self._ahead = [x + b * u for x, b in zip(self._ahead, self._b, strict=True)], []
        return self._model.c * self.state[0]

    def correct(self, innovation: float) -> None:
        """Correct the state by an innovation, y minus its prediction."""
        self.state = [x + k * innovation for x, k in zip(self.state, self._gain.gain, strict=True)]
        self.variance += (innovation * innovation - self.variance) / 100.0

    def settle(self, noise_std: float) -> None:
        """Move one level towards the smallest gain that explains the innovations; set the noise."""
        gain, level = self._gain, self.level
        # An excess of up to 15 % is put down to chance.
        if self.variance > (1.15 * gain.innovation * noise_std) ** 2:
            level = min(level + 1, len(RATIOS) - 1)
        elif self.variance < gain.innovation * gain.quiet * noise_std**2:
            level = max(level - 1, 0)
        self._set_level(level, noise_std)


class Place(NamedTuple):
    """Where a fit ends: p, and x of `model` in observer form; u, y of its newest samples (M,).
    crossings: m, c_r, c_l (3,) to go on with. noise: standard deviation of y."""

    p: float
    u: Array
    y: Array
    model: TransferFunction
    x: Array
    crossings: Array
    noise: float


class Following:
    """Advances the play operator and the state of G from sample to sample.

    The state comes from `before` until a backlash is known, then from `observer`. since_motion,
    since_v_moved: samples since p and v last moved. outliers: readings rejected so far. beyond:
    readings beyond the gate in a row.
    """

    def __init__(self, model: StateModel, before: FixedBacklash | None) -> None:
        self.model, self.before = model, before
        self._gains: Sequence[Gain] = ()
        self.observer: Observer | None = None
        self.u = self.innovation = nan
        self.since_motion = self.since_v_moved = self.outliers = self.beyond = 0
        self._v = self._p = nan  # p is v until a backlash is known
        # Newest samples, as two queues of floats: pairs would burden the garbage collector.
        self._u, self._y = deque[float](maxlen=ROWS), deque[float](maxlen=ROWS)

    @property
    def surprised(self) -> bool:
        """Whether the newest reading makes too many in a row beyond the gate to be outliers."""
        return self.beyond == OUTLIERS and not isnan(self.innovation)

    @property
    def x_hat(self) -> list[float]:
        if self.observer is not None:
            return self.observer.state
        return [0.0] * self.model.order if self.before is None else self.before.x_hat

    def change_model(self, model: StateModel, gains: Sequence[Gain]) -> None:
        self.model, self._gains = model, gains
        if self.before is not None:
            self.before = self.before.with_model(model)
        if self.observer is not None:
            self.observer = Observer(model, self.observer.noise_std, gains, self.observer)
            u, y = np.array(self._u), np.array(self._y)
            if np.isfinite(y).sum() > model.order:
                self.observer.place(state_after(model.transfer_function, u, y), True)

    def step(self, y: float | None, interval: Interval, estimate: Estimate) -> None:
        """Process y(k), None if it was lost, and v of the interval before it."""
        observer, v, p = self.observer, interval.v, self._p
        if observer is None:
            self._p = v
            if self.before is not None:
                self.before.update(y, interval)
        else:
            self._p = clamp(p, v, v + estimate.c_r - estimate.c_l)
            self.u = estimate.m * (self._p - estimate.c_r)
            self._u.append(self.u)
            self._y.append(nan if y is None else y)
            expected, self.innovation = observer.predict(self.u), nan
            if y is not None:
                self.innovation = innovation = y - expected
                inside = innovation * innovation <= GATE**2 * observer.variance
                self.beyond = 0 if inside else self.beyond + 1
                if inside or self.beyond >= OUTLIERS:  # too many for outliers
                    observer.correct(innovation)
                else:
                    self.outliers += 1
        self.since_motion = self.since_motion + 1 if self._p == p else 0
        self.since_v_moved = self.since_v_moved + 1 if self._v == v else 0
        self._v = v

    def go_on_from(self, place: Place, newer: Array, estimate: Estimate, known: bool) -> None:
        """Set play and observer to where a fit ended, then advance them by newer v, y (2, M).

        known: whether to trust the state of the fit more than newer samples.
        """
        if not place.model.equals(self.model.transfer_function):
            return  # another G was adopted meanwhile
        self.observer = observer = self.observer or Observer(self.model, place.noise, self._gains)
        observer.settle(place.noise)
        observer.place(place.x, known)
        v, y = newer
        p = np.append(place.p, play(v, estimate.c_r - estimate.c_l, place.p) if len(v) else v)
        u = estimate.m * (p - estimate.c_r)
        self._p, self.u = float(p[-1]), float(u[-1])
        self._u = deque([*place.u.tolist(), *u[1:].tolist()], ROWS)
        self._y = deque([*place.y.tolist(), *y.tolist()], ROWS)
        for before, after in zip(u[1:].tolist(), y.tolist(), strict=True):
            innovation = after - observer.predict(before)
            if innovation * innovation <= GATE**2 * observer.variance:  # false if y was lost (nan)
                observer.correct(innovation)
