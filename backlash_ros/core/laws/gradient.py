"""The adaptive law of Tao and Kokotović: a normalized gradient for the products.

With theta = (m, m c_r, m c_l) and phi = (v, -1{right}, -1{left}), u = theta' phi. Seen through the
filters of pole_placement.py, the plant with the true theta satisfies

    y + B R/(Lambda A_m) y = W u

so that, with zeta = W phi, the estimation error eps is linear in the parameter error:

    eps = y + B R/(Lambda A_m) y - theta_hat' zeta = (theta - theta_hat)' zeta
    theta_hat(k+1) = theta_hat(k) + step P zeta eps / (zeta' P zeta + xi^2/u_s^2 + a^2)

with xi = theta_hat' zeta - W u_d. P = diag(1/v_s^2, 1, 1); v_s^2, u_s^2 and 10 a^2
are means of v^2, u_d^2 and zeta' P zeta; a is at least 10 / u_s times the std of the noise on y.

Reference: G. Tao, P. V. Kokotović, Adaptive Control of Systems with Actuator and Sensor
Nonlinearities, Wiley 1996.
"""

from dataclasses import dataclass
from math import nan

import numpy as np

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.input_reconstruction import LEAST_SQUARE, MEMORY, Agreement
from backlash_ros.core.parameters import Bounds
from backlash_ros.core.plant.numerics import FourBlocks
from backlash_ros.core.plant.transfer_function import Array


@dataclass
class Means:
    """Running means of v^2, u_d^2 and zeta' P zeta, which normalize the adaptation."""

    v_square: float = 0.0
    u_square: float = 0.0
    size: float = 0.0  # of zeta' P zeta
    samples: int = 0  # so far; weights fade over MEMORY of them


class GradientEstimator(Law):
    """Learns (m, m c_r, m c_l) from y through the filters of the four-block loop.

    step: gain, 0 < step < 2. noise_std: of y. While y moves against v, nothing is learned.
    innovation: y(k) minus its prediction. u_hat: u that the estimate gives on the line in use.
    """

    innovation, u_hat = nan, 0.0

    def __init__(
        self, initial: Estimate, bounds: Bounds, blocks: FourBlocks, step: float, noise_std: float,
    ) -> None:
        self.estimate, self.step = initial, step
        self._bounds, self._noise_square = bounds, (10.0 * noise_std) ** 2
        self._agreement, self._means = Agreement(), Means()
        # Filters W for phi and u_d, and the one for y, each with its state in observer form.
        self._filters = [(model, [0.0] * model.order) for model in (
            *[blocks.disturbance] * 4, blocks.returned)]
        self._y = 0.0  # newest y, or its prediction
        self._phi: Array = np.zeros(3)

    def update(self, y: float | None, interval: Interval) -> None:
        old, means = self.estimate, self._means
        self._phi = self._engaged(interval, old)
        theta = np.array([old.m, old.m * old.c_r, old.m * old.c_l])
        self.u_hat = float(theta @ self._phi)
        inputs = *self._phi.tolist(), interval.u_d, self._y
        *of_phi, demanded, returned = (
            model.advance(x, u) for (model, x), u in zip(self._filters, inputs, strict=True))
        zeta = np.array(of_phi)
        means.samples += 1
        share = 1.0 / min(means.samples, MEMORY)
        means.v_square += share * (interval.v**2 - means.v_square)
        means.u_square += share * (interval.u_d**2 - means.u_square)
        expected = float(theta @ zeta) - returned
        if y is None:
            self.innovation, self._y = nan, expected
            return
        self._y, self.innovation = y, y - expected
        if min(means.v_square, means.u_square) < LEAST_SQUARE:
            return
        xi = float(theta @ zeta - demanded)
        scaled = zeta * np.array([1.0 / means.v_square, 1.0, 1.0])
        size = float(zeta @ scaled)
        means.size += share * (size - means.size)
        least = max(0.1 * means.size, self._noise_square / means.u_square)
        norm = size + least + xi**2 / means.u_square
        if norm == 0.0 or not self.adapting:
            return
        new = old
        if old.status is not Status.INCONSISTENT:
            theta = theta + (self.step * self.innovation / norm) * scaled
            new = Estimate(*self._bounds.of_products(*theta.tolist()), old.f, status=old.status)
        self.estimate = self._agreement.judged(new, (*zeta.tolist(), y + returned))

    def _engaged(self, interval: Interval, used: Estimate) -> Array:
        """phi for the line on which v lies; between the lines, the previous phi."""
        v, line = interval.v, interval.u_d / used.m
        near = 1e-9 * (abs(v) + abs(line))
        right, left = abs(v - line - used.c_r) <= near, abs(v - line - used.c_l) <= near
        if not (right or left):
            right = self.u_hat < used.m * (v - used.c_r)
            left = self.u_hat > used.m * (v - used.c_l)
        if right:
            return np.array([v, -1.0, 0.0])
        return np.array([v, 0.0, -1.0]) if left else self._phi
