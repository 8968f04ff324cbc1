"""A law that does not learn: a backlash measured by hand, or none, is used as it is."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import numpy as np

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.numerics import NoiseLevel
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
        n = model.order
        self._model, self._doubt = model, doubt
        self._transition = np.eye(n + 1)
        self._transition[:n, :n], self._transition[:n, n] = model.a, model.b
        self._noise_std, self._noise = max(noise_std, 1e-12), NoiseLevel()
        self._x: Array = np.zeros(n + 1)
        self._p: Array = np.zeros((n + 1, n + 1))
        self._u, self._started = 0.0, False

    def with_model(self, model: StateModel) -> FixedBacklash:
        return FixedBacklash(self.estimate, model, self._noise_var**0.5, self._doubt)

    @property
    def u_hat(self) -> float:
        return self._u + float(self._x[-1])

    @property
    def _noise_var(self) -> float:
        return max(self._noise.std, self._noise_std) ** 2

    @property
    def x_hat(self) -> Array:
        return self._x[:-1]

    @property
    def x_cov(self) -> Array:
        return self._p[:-1, :-1]

    def predicted(self, u: float) -> float:
        """Prediction of y(k+1) if the backlash puts out this u."""
        return self._model.c * float(self._transition[0] @ self._x + self._model.b[0] * u)

    def update(self, y: float | None, interval: Interval) -> None:
        e, v, before = self.estimate, interval.v, self._u
        self._u = clamp(before, e.m * (v - e.c_r), e.m * (v - e.c_l))
        x = self._transition @ self._x
        x[:-1] += self._model.b * self._u
        p = self._transition @ self._p @ self._transition.T
        p[-1, -1] += (self._doubt * (self._u - before)) ** 2
        self.innovation = nan
        if y is not None:
            if not self._started:
                # A prior that is wide compared with the first output and the noise.
                x_scale = 1e3 * (abs(y) + self._noise_var**0.5)
                p[:-1, :-1] += x_scale**2 * np.eye(len(x) - 1)
                self._started = True
            c = self._model.c
            cross = c * p[:, 0]
            variance = c * cross[0] + self._noise_var
            self.innovation = y - c * float(x[0])
            self._noise.take(self.innovation)
            gain = cross / variance
            x = x + gain * self.innovation
            p -= np.outer(gain, cross)
            p = 0.5 * (p + p.T)
        self._x, self._p = x, p
