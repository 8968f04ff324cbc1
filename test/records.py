"""Records of v and y for the tests of the default law, simulated without its code."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

PERIOD_S = 0.005


class Truth(NamedTuple):
    """A backlash. share: of the gap, where the play output stands before the first sample."""

    m: float = 1.3
    c_r: float = 1.0
    c_l: float = -0.8
    share: float = 0.4

    @property
    def gap(self) -> float:
        return self.c_r - self.c_l

    @property
    def theta(self) -> Array:
        return self.m * np.array([1.0, self.c_r, self.c_l])

    def start(self, v: Array) -> float:
        return float(v[0]) + self.share * self.gap


def two_poles(omega_t: float, damping: float = 0.5) -> TransferFunction:
    b, a, _ = cont2discrete(([omega_t**2], [1.0, 2.0 * damping * omega_t, omega_t**2]), 1.0)
    return TransferFunction(b[0, 1:].tolist(), a.tolist())


def resonance(frequency_hz: float = 5.0, damping: float = 0.5) -> TransferFunction:
    return two_poles(2.0 * np.pi * frequency_hz * PERIOD_S, damping)


def swing(count: int, size: float = 3.0, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    t = PERIOD_S * np.arange(count)
    return size / 2.0 * sum(
        np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 2.0 * np.pi)) for f in (0.7, 1.9, 3.7))


def moves_with_rests(goals: Array, pace: float, rest: int) -> Array:
    """v from 0 to each goal, by `pace` a sample at most, with so many samples of rest there."""
    pieces, x = [np.zeros(1)], 0.0
    for goal in goals.tolist():
        pieces += [np.linspace(x, goal, int(abs(goal - x) / pace) + 2), np.full(rest, goal)]
        x = goal
    return np.concatenate(pieces)


def output(
    model: TransferFunction, v: Array, truth: Truth, noise_std: float = 0.0, seed: int = 0,
) -> Array:
    """y (N,) after each v (N,), from rest at the u held before."""
    held = truth.m * (truth.start(v) - truth.c_r)
    backlash = Backlash(truth.m, truth.c_r, truth.c_l, held)
    a, b, c = model.state_space()
    x = np.linalg.solve(np.eye(model.order) - a, b * held)
    y = []
    for value in v.tolist():
        x = a @ x + b * backlash.step(value)
        y.append(float(c @ x))
    return np.array(y) + noise_std * np.random.default_rng(seed).standard_normal(len(v))
