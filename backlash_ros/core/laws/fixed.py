"""A law that does not learn: a backlash measured by hand, or none, is used as it is."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import numpy as np

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.numerics import NoiseLevel, dot
from backlash_ros.core.plant.transfer_function import Array, StateModel


class FixedBacklash(Law):
    """Keeps its estimate; a Kalman filter tracks the state of G and a slow disturbance d of u.

    noise_std: of y; if the innovations show more white noise, that is used instead. doubt: std of
    the change of d per sample, over the change of u that the constants predict.
    """

    adapting = False
    innovation = nan

    def __init__(
        self, initial: Estimate, model: StateModel, noise_std: float, doubt: float,
    ) -> None:
        self.estimate = replace(
            initial, std_m=0.0, std_c_r=0.0, std_c_l=0.0, status=Status.TRACKING)
        self._doubt, n = doubt, model.order
        self._b: list[float] = [*model.b.tolist(), 0.0]
        self._c = model.c
        self._transition = np.eye(n + 1)
        self._transition[:n, :n], self._transition[:n, n] = model.a, model.b
        # x is advanced without NumPy, whose first calls after a pause take long.
        self._rows: list[list[float]] = self._transition.tolist()
        self._noise_std, self._noise = max(noise_std, 1e-12), NoiseLevel()
        self._x, self._u, self._started = [0.0] * (n + 1), 0.0, False
        # Covariances of x (n + 1, n + 1): after the newest sample and, without the change of d,
        # before the next one. They do not depend on y(k).
        self._p: Array = np.zeros((n + 1, n + 1))
        self._p_ahead = self._p.copy()
        # Change of d, and whether y came, of the newest sample; None: they are in _p.
        self._newest: tuple[float, bool] | None = None
        self._look_ahead()

    def with_model(self, model: StateModel) -> FixedBacklash:
        self.prepare()
        return FixedBacklash(self.estimate, model, self._noise_var**0.5, self._doubt)

    @property
    def u_hat(self) -> float:
        return self._u + self._x[-1]

    @property
    def _noise_var(self) -> float:
        return max(self._noise.std, self._noise_std) ** 2

    @property
    def x_hat(self) -> list[float]:
        return self._x[:-1]

    @property
    def x_cov(self) -> Array:
        self.prepare()
        return self._p[:-1, :-1]

    def predicted(self, u: float) -> float:
        """Prediction of y(k+1) if the backlash puts out this u."""
        self.prepare()
        return self._c * (self._x_ahead[0] + self._b[0] * u)

    def update(self, y: float | None, interval: Interval) -> None:
        self.prepare()
        e, v, before = self.estimate, interval.v, self._u
        self._u = u = clamp(before, e.m * (v - e.c_r), e.m * (v - e.c_l))
        self._x = x = [ahead + b * u for ahead, b in zip(self._x_ahead, self._b, strict=True)]
        self.innovation = nan
        if y is not None:
            if not self._started:
                # A prior that is wide compared with the first output and the noise.
                wide = 1e3 * (abs(y) + self._noise_var**0.5)
                self._p_ahead[:-1, :-1] += wide**2 * np.eye(len(x) - 1)
                self._started = True
                self._look_ahead()
            self.innovation = innovation = y - self._c * x[0]
            for i, gain in enumerate(self._gain):
                x[i] += gain * innovation
        self._newest = self._doubt * (u - before), y is not None

    def prepare(self) -> None:
        if self._newest is None:
            return
        (change, heard), self._newest, p = self._newest, None, self._p_ahead
        p[-1, -1] += change**2
        if heard:
            # In Joseph's form, which stays positive however wide the prior is beside the noise.
            kept, gain = np.eye(len(p)), np.array(self._gain)
            kept[:, 0] -= self._c * gain
            p = kept @ p @ kept.T + self._noise_var * np.outer(gain, gain)
            self._noise.take(self.innovation)
        self._p = 0.5 * (p + p.T)
        self._p_ahead = self._transition @ self._p @ self._transition.T
        self._look_ahead()

    def _look_ahead(self) -> None:
        """Compute the gain for the next sample, and x then, but for u and y: lists, as above."""
        cross = self._c * self._p_ahead[:, 0]
        self._gain: list[float] = (cross / (self._c * cross[0] + self._noise_var)).tolist()
        self._x_ahead = [dot(row, self._x) for row in self._rows]
