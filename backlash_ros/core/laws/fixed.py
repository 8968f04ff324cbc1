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
        # Roots S of covariances S'S of x (n + 1, n + 1): after the newest sample and, without the
        # change of d, before the next one. They do not depend on y(k), and keep the covariance
        # positive however wide the prior is beside the noise.
        self._root: Array = np.zeros((n + 1, n + 1))
        self._root_ahead = self._root.copy()
        # Change of d, and whether y came, of the newest sample; None: they are in _root.
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
        return np.asarray(self._root.T @ self._root)[:-1, :-1]

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
                self._root_ahead = _root_of(self._root_ahead, wide * np.eye(len(x) - 1, len(x)))
                self._started = True
                self._look_ahead()
            self.innovation = innovation = y - self._c * x[0]
            for i, gain in enumerate(self._gain):
                x[i] += gain * innovation
        self._newest = self._doubt * (u - before), y is not None

    def prepare(self) -> None:
        if self._newest is None:
            return
        (change, heard), self._newest, size = self._newest, None, len(self._x)
        root = np.vstack([self._root_ahead, change * np.eye(1, size, size - 1)])
        if heard:  # the array form of a Kalman filter: y and x, then x given y
            of_y = self._noise_var**0.5 * np.eye(1, size + 1)
            root = _root_of(np.column_stack([self._c * root[:, 0], root]), of_y)[1:, 1:]
            self._noise.take(self.innovation)
        self._root = root if heard else _root_of(root)
        self._root_ahead = self._root @ self._transition.T
        self._look_ahead()

    def _look_ahead(self) -> None:
        """Compute the gain for the next sample, and x then, but for u and y: lists, as above."""
        cross = self._c * (self._root_ahead[:, 0] @ self._root_ahead)
        self._gain: list[float] = (cross / (self._c * cross[0] + self._noise_var)).tolist()
        self._x_ahead = [dot(row, self._x) for row in self._rows]


def _root_of(*rows: Array) -> Array:
    """A root (n, n) of the sum of the covariances that these have as rows of roots, each (m, n)."""
    return np.asarray(np.linalg.qr(np.vstack(rows), mode='r'))
