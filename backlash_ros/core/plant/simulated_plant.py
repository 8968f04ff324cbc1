"""The plant the controller does not know in full: backlash, then G(z), then a sensor (3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import Backlash, check_backlash
from backlash_ros.core.plant.transfer_function import TransferFunction


@dataclass(frozen=True)
class Imperfections:
    """What a real plant adds to (3.1).

    output_noise_std: standard deviation of white noise on y [unit of y].
    output_quantum: step of the sensor, 0 for none [unit of y].
    input_disturbance: constant added to u [unit of u].
    walk_std: random walk added to u, from 0 on [unit of u per square root of a second].
    rate: drift of (m, c_r, c_l) per second, absolute.
    jump_time, jump: at jump_time [s] jump is added to (m, c_r, c_l).
    """

    output_noise_std: float = 0.0
    output_quantum: float = 0.0
    input_disturbance: float = 0.0
    walk_std: float = 0.0
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    jump_time: float = 0.0
    jump: tuple[float, float, float] = (0.0, 0.0, 0.0)


class SimulatedPlant:
    """y = G(z) (B[v] + d + w), measured with noise and a quantum.

    d is constant, w a random walk, w(k+1) = w(k) + walk_std sqrt(T) N(0, 1), w(0) = 0.
    backlash: its u is the held output at the start. rng: source of the noise and of the walk.
    actuator: what makes v of the command, None where they are one. applied: the newest v.
    """

    def __init__(
        self, model: TransferFunction, backlash: Backlash, sample_period: float,
        rng: np.random.Generator, imperfections: Imperfections | None = None,
        actuator: Actuator | None = None,
    ) -> None:
        self.backlash, self.applied = backlash, 0.0
        self._motor = None if actuator is None else Motor(actuator)
        self.sample = 0
        self._initial = (backlash.m, backlash.c_r, backlash.c_l)
        self._model, self._x = model, [0.0] * model.order
        self._sample_period = sample_period
        self._rng = rng
        self._extra = imperfections or Imperfections()
        self._walk = 0.0
        self._walk_step = self._extra.walk_std * sqrt(sample_period)
        # Draws of their own: the noise on y is the same with and without a walk.
        self._walk_rng = rng.spawn(1)[0] if self._walk_step > 0.0 else rng
        self._wears = any(self._extra.rate) or any(self._extra.jump)

    @property
    def disturbance(self) -> float:
        """What is added to u: a constant and a walk."""
        return self._extra.input_disturbance + self._walk

    def go_on_from(self, other: SimulatedPlant) -> None:
        """Take over the state, the time and the source of noise of a plant with the same G(z)."""
        self.sample, self._x, self._rng = other.sample, list(other._x), other._rng
        self._walk, self._walk_rng = other._walk, other._walk_rng
        self.backlash.u, self.backlash.region = other.backlash.u, other.backlash.region
        self._motor, self.applied = other._motor, other.applied

    def measure(self) -> float:
        """y(k) as the sensor shows it; call it once per sample."""
        y = self._x[0]
        if self._extra.output_noise_std > 0.0:
            y += self._extra.output_noise_std * float(self._rng.standard_normal())
        if self._extra.output_quantum > 0.0:
            y = self._extra.output_quantum * round(y / self._extra.output_quantum)
        return y

    def step(self, v: float) -> float:
        """Apply a command over one sample period and return u = B[v], without the disturbances."""
        if self._wears:
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
        t = self.sample * self._sample_period
        jumped = self._extra.jump if t >= self._extra.jump_time else (0.0, 0.0, 0.0)
        m, c_r, c_l = (
            value + rate * t + jump
            for value, rate, jump in zip(self._initial, self._extra.rate, jumped, strict=True)
        )
        check_backlash(m, c_r, c_l)
        self.backlash.m, self.backlash.c_r, self.backlash.c_l = m, c_r, c_l
