"""State of G between two solutions of the fit: an observer with a constant gain.

In the observer form, whose first state is y, a step costs a few products:

    x_i(k+1) = x_{i+1}(k) - a_i x_1(k) + b_i u(k) + k_i (y(k) - x_1(k))

The gain is that of the stationary Kalman filter for white noise on u of the size at which the
innovations are as large as they are (R. K. Mehra, On the identification of variances and adaptive
Kalman filtering, IEEE Trans. Automatic Control 15 (1970) 175-184).
"""

from __future__ import annotations

from math import sqrt
from operator import mul
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.riccati import lyapunov, riccati
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

# Noise on u, as its stationary share of y in units of the noise of y, that gains are made for.
RATIO_STEP = 10.0  # ratio of neighbours
RATIOS = tuple(RATIO_STEP**exponent for exponent in range(-4, 5))
INNOVATIONS = 100  # samples over which innovations are averaged
NOISIER = 1.15  # ratio of their deviation to the expected one that chance explains
# --- guards
REGULAR = 1e-9  # noise on every state beside that on u: keeps the Riccati equation regular


class Gain(NamedTuple):
    """gain: after a prediction, in the observer form. innovation: its deviation over that of y.

    cov: of the state in the coordinates of StateModel, in units of the variance of y, (n, n).
    quiet: what `innovation` is with this gain where the noise on u is that of the next smaller one.
    """

    gain: tuple[float, ...]
    innovation: float
    cov: Array
    quiet: float


def gain_of(model: StateModel, ratio: float) -> Gain | None:
    """Gain for noise on u of this size; None where there is none."""
    n, transfer = model.order, model.transfer_function
    power = abs(transfer.response(np.array([np.exp(0.1j * np.pi)]))[0])
    c = np.zeros((n, 1))
    c[0, 0] = model.c
    noise = np.outer(model.b, model.b) * (ratio / power) ** 2
    noise += REGULAR * float(np.trace(noise)) * np.eye(n)
    try:
        p = riccati(model.a.T, c[:, 0], noise)
        variance = float(model.c * p[0, 0] * model.c) + 1.0
        column = p[:, 0] * model.c / variance
        # Error of the prediction with this gain: P = (A - A k c) P (A - A k c)' + A k k' A' + Q.
        after = model.a @ column
        quiet = lyapunov(
            model.a - np.outer(after, c), np.outer(after, after) + noise * RATIO_STEP**-2
        )
    except np.linalg.LinAlgError:
        return None
    return Gain(
        tuple((model.to_observer @ column).tolist()), sqrt(variance),
        p - np.outer(column, column) * variance,
        sqrt(float(model.c * quiet[0, 0] * model.c) + 1.0),
    )


Gains = dict[float, Gain | None]


def gains_of(model: StateModel) -> Gains:
    """Gains for noise on u of every size."""
    return {ratio: gain_of(model, ratio) for ratio in RATIOS}


class Observer:
    """Follows the state of G. noise_std: of y.

    before: that of another G for the same plant: innovations are no larger with this one. gains:
    where they are known already.
    """

    def __init__(
        self, model: StateModel, noise_std: float, before: Observer | None = None,
        gains: Gains | None = None,
    ) -> None:
        self.model = model
        self._gains: Gains = {} if gains is None else gains
        self._transfer = model.transfer_function
        self._n = model.order
        self._x = [0.0] * self._n
        self.noise_std = noise_std
        self._level = len(RATIOS) // 2
        if before is not None:
            self._level = min(before._level, self._level)
        self._gain = self._gain_at(self._level)
        self.variance = (self._gain.innovation * noise_std) ** 2  # of the innovation, measured
        self._to_state = tuple(map(tuple, model.to_state.tolist()))
        self.cov: Array = self.noise_cov  # of the state

    @property
    def state(self) -> list[float]:
        """x in the coordinates of StateModel, n values."""
        x = self._x
        return [sum(map(mul, row, x)) for row in self._to_state]

    @property
    def noise_cov(self) -> Array:
        """Covariance of the state while the innovations are what they are, shape (n, n)."""
        return self._gain.cov * self.noise_std**2

    def place(self, x: Array, known: bool) -> None:
        """Go on from the state x in the observer form.

        known: whether a fit knows it better than the newest samples do, so that they are to move
        it little.
        """
        self._x = x.tolist()
        if known:
            self._level, self._gain = 0, self._gain_at(0)
        self.cov = self.noise_cov

    def predict(self, u: float) -> float:
        """Take u over one period and return the y that is expected after it."""
        return self._transfer.advance(self._x, u)

    def correct(self, innovation: float) -> None:
        """Take in y minus what was expected."""
        x = self._x
        for i, k in enumerate(self._gain.gain):
            x[i] += k * innovation
        self.variance += (innovation * innovation - self.variance) / INNOVATIONS

    def settle(self, noise_std: float) -> None:
        """Go a step towards the smallest gain that explains the innovations.

        noise_std: of y from now on.
        """
        self.noise_std = noise_std
        gain = self._gain
        if self.variance > (NOISIER * gain.innovation * noise_std) ** 2:
            self._level = min(self._level + 1, len(RATIOS) - 1)
        elif self.variance < gain.innovation * gain.quiet * noise_std**2:
            self._level = max(self._level - 1, 0)
        self._gain = self._gain_at(self._level)
        self.cov = self.noise_cov

    def _gain_at(self, level: int) -> Gain:
        ratio = RATIOS[level]
        if ratio not in self._gains:
            self._gains[ratio] = gain_of(self.model, ratio)
        gain = self._gains[ratio]
        if gain is None:
            n = self._n
            return Gain((0.0,) * n, 1.0, np.eye(n), 1.0)
        return gain
