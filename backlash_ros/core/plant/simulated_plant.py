"""The plant the controller does not know in full: backlash, then G(z), then a sensor (3.1)."""

from __future__ import annotations

from math import sqrt

import numpy as np

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import Backlash, check_backlash
from backlash_ros.core.plant.transfer_function import TransferFunction


class SimulatedPlant:
    """y = G(z) (B[v] + d + w), measured with noise and a quantum.

    d is constant, w a random walk, w(k+1) = w(k) + walk_std sqrt(T) N(0, 1), w(0) = 0. p: has the
    backlash, its drift and its jump, the noise, d, the walk of u and the seed. model: the true
    G(z). actuator: what makes v of the command, None where they are one. applied: the newest v.
    sample: number of the next one.
    """

    def __init__(
        self, p: Parameters, model: TransferFunction, actuator: Actuator | None = None,
    ) -> None:
        hidden = p.backlash
        self.backlash = Backlash(hidden.m, hidden.c_r, hidden.c_l, hidden.initial_u)
        self.applied, self.sample = 0.0, 0
        self._p, self._model, self._x = p, model, [0.0] * model.order
        self._motor = None if actuator is None else Motor(actuator)
        self._rng = np.random.default_rng(p.seed)
        self._walk, self._walk_step = 0.0, p.truth.walk_std * sqrt(p.sample_period)
        # Draws of their own: the noise on y is the same with and without a walk.
        self._walk_rng = self._rng.spawn(1)[0] if self._walk_step > 0.0 else self._rng

    @property
    def disturbance(self) -> float:
        """What is added to u: a constant and a walk."""
        return self._p.input_disturbance + self._walk

    def go_on_from(self, other: SimulatedPlant) -> None:
        """Take over the state, the time and the source of noise of a plant with the same G(z)."""
        self.sample, self._x, self._rng = other.sample, list(other._x), other._rng
        self._walk, self._walk_rng = other._walk, other._walk_rng
        self.backlash.u, self.backlash.region = other.backlash.u, other.backlash.region
        self._motor, self.applied = other._motor, other.applied

    def measure(self) -> float:
        """y(k) as the sensor shows it; call it once per sample."""
        y = self._x[0]
        noise_std, quantum = self._p.output_noise_std, self._p.output_quantum
        if noise_std > 0.0:
            y += noise_std * float(self._rng.standard_normal())
        return quantum * round(y / quantum) if quantum > 0.0 else y

    def step(self, v: float) -> float:
        """Apply a command over one sample period and return u = B[v], without the disturbances."""
        if any(self._p.backlash.rate) or any(self._p.backlash.jump):
            self._wear()
        if self._motor is not None:
            held = self.backlash
            v = self._motor.step(v, held.u / held.m, held.c_r, held.c_l)
        self.applied = v
        u = self.backlash.step(v)
        self._model.advance(self._x, u + self.disturbance)
        if self._walk_step > 0.0:
            self._walk += self._walk_step * float(self._walk_rng.standard_normal())
        self.sample += 1
        return u

    def _wear(self) -> None:
        hidden, t = self._p.backlash, self.sample * self._p.sample_period
        jump = hidden.jump if t >= hidden.jump_time else (0.0, 0.0, 0.0)
        begun_with = hidden.m, hidden.c_r, hidden.c_l
        m, c_r, c_l = (
            value + rate * t + step
            for value, rate, step in zip(begun_with, hidden.rate, jump, strict=True)
        )
        check_backlash(m, c_r, c_l)
        self.backlash.m, self.backlash.c_r, self.backlash.c_l = m, c_r, c_l
