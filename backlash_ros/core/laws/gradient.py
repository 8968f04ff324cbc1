"""The adaptation of Tao and Kokotović: a normalised gradient on the products.

With theta = (m, m c_r, m c_l) and phi = (v, -1{right}, -1{left}), u = theta' phi, the plant
behind the filters of pole_placement.py answers to the true theta with

    y + B R/(Lambda A_m) y = W u

so that with zeta = W phi the estimation error is linear in the parameter error:

    eps = y + B R/(Lambda A_m) y - theta_hat' zeta = (theta - theta_hat)' zeta
    theta_hat(k+1) = theta_hat(k) + step P zeta eps / (zeta' P zeta + xi^2/u_s^2 + a^2)

xi = theta_hat' zeta - W u_d is the swapping term. P = diag(1/v_s^2, 1, 1) gives the slope and the
crossings regressors of one size; v_s^2, u_s^2 and 10 a^2 are the means of v^2, u_d^2 and
zeta' P zeta, so that no unit matters; a is at least 10 deviations of the noise on y over u_s. The
side of phi is the one the inverse used, and that of a backlash theta_hat where v lies on no line of
the inverse: limited, or not compensated. As long as the loop is that of pole_placement.py,
B R/(Lambda A_m) y = W u_d - y_ref with y_ref = theta_3 B/A_m y_m: then eps is what y differs from
y_ref by, beyond the swapping term.

Reference: G. Tao, P. V. Kokotović, Adaptive Control of Systems with Actuator and Sensor
Nonlinearities, Wiley 1996.
"""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.agreement import LEAST_SQUARE, MEMORY, Agreement
from backlash_ros.core.plant.four_blocks import FourBlocks

Array = NDArray[np.float64]


class _Filters:
    """W of phi and of u_d, and what returns of y, side by side in observer form."""

    def __init__(self, blocks: FourBlocks) -> None:
        models = [*[blocks.disturbance] * 4, blocks.returned]
        self._a = models[0].state_space()[0]
        self._b: Array = np.column_stack([model.state_space()[1] for model in models])
        self._x: Array = np.zeros(self._b.shape)

    def step(self, inputs: Array) -> Array:
        """Their outputs after one more sample."""
        self._x = self._a @ self._x + self._b * inputs
        return np.asarray(self._x[0])


class GradientEstimator(Law):
    """Learns (m, m c_r, m c_l) from y behind the filters of the four-block loop.

    step: 0 < step < 2. noise_std: of y. Where y moves against v nothing is learned.
    """

    def __init__(
        self, initial: Estimate, bounds: Bounds, blocks: FourBlocks, step: float, noise_std: float,
    ) -> None:
        self.estimate = initial
        self.step = step
        self._innovation, self._u_hat = nan, 0.0
        self._bounds, self._noise_square = bounds, (10.0 * noise_std) ** 2
        self._y = 0.0  # the newest one, or what was expected of it
        self._agreement = Agreement()
        self._filters = _Filters(blocks)
        self._phi: Array = np.zeros(3)
        self._means = [0.0, 0.0, 0.0]  # of v^2, u_d^2 and zeta' P zeta
        self._samples = 0

    @property
    def innovation(self) -> float:
        """y(k) minus what was expected of it; nan where y(k) was lost."""
        return self._innovation

    @property
    def u_hat(self) -> float:
        """u of the estimate on the line in use."""
        return self._u_hat

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and what was applied from k-1 to k."""
        old = self.estimate
        self._engage(interval, old)
        theta = np.array([old.m, old.m * old.c_r, old.m * old.c_l])
        self._u_hat = float(theta @ self._phi)
        filtered = self._filters.step(np.concatenate((self._phi, (interval.u_d, self._y))))
        self._samples += 1
        share = 1.0 / min(self._samples, MEMORY)
        v_square, u_square, mean_size = self._means
        v_square += share * (interval.v**2 - v_square)
        u_square += share * (interval.u_d**2 - u_square)
        self._means = [v_square, u_square, mean_size]
        zeta = filtered[:3]
        returned = float(filtered[4])
        expected = float(theta @ zeta) - returned
        if y is None:
            self._innovation, self._y = nan, expected
            return
        self._y = y
        xi = float(theta @ zeta - filtered[3])
        eps = self._innovation = y - expected
        if min(v_square, u_square) < LEAST_SQUARE:
            return
        scaled = zeta * np.array([1.0 / v_square, 1.0, 1.0])
        size = float(zeta @ scaled)
        mean_size += share * (size - mean_size)
        self._means[2] = mean_size
        norm = size + max(0.1 * mean_size, self._noise_square / u_square) + xi**2 / u_square
        if norm == 0.0 or not self.adapting:
            return
        row = (*zeta.tolist(), y + returned)
        new = old
        if old.status is not Status.INCONSISTENT:
            theta = theta + (self.step * eps / norm) * scaled
            new = Estimate(*self._bounds.of_products(*theta.tolist()), old.f)
        self.estimate = self._agreement.judged(new, row)

    def _engage(self, interval: Interval, used: Estimate) -> None:
        """Set phi for the line on which v lies; between lines the last one holds."""
        v, line = interval.v, interval.u_d / used.m
        near = 1e-9 * (abs(v) + abs(line))
        right, left = abs(v - line - used.c_r) <= near, abs(v - line - used.c_l) <= near
        if not (right or left):
            right = self._u_hat < used.m * (v - used.c_r)
            left = self._u_hat > used.m * (v - used.c_l)
        if right:
            self._phi = np.array([v, -1.0, 0.0])
        elif left:
            self._phi = np.array([v, 0.0, -1.0])
