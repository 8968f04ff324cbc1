"""u from y alone: a fixed-lag Kalman smoother of the unknown input of G.

G may have zeros outside the unit circle, so that 1/G is unstable forwards in time. Looking back
by a few samples makes the inversion stable: an unstable zero z0 is inverted backwards in time,
where it decays like |z0|^-lag. The input is modelled as a random walk u(k+1) = u(k) + w, which
also bounds the inversion where G has zeros on the unit circle.

Reference: B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 7.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.model_check import check_model
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

# y is scaled so that a typical step of u, of size 1, shows in it with size 1. The floors say how
# much noise the smoother assumes at least: this share of the weakest response, which counts as no
# weaker than so much of the typical one.
NOISE_FLOOR, WEAKEST = 1e-3, 1e-4
# After a lost sample the covariances take this many lags to become stationary again.
LAGS_TO_STEADY = 4
TOO_NOISY = 'is so large that y says nothing of u'


@dataclass
class _Covariance:
    """p: of the predicted [x; u]. rows: of u(k-i), i = 0 .. lag, with it. var: of u(k-i)."""

    p: Array
    rows: Array
    var: Array


class InputReconstruction:
    """Fixed-lag smoother: u_hat(k - lag) from y(..k).

    model: G(z). noise_std: standard deviation of the noise on y. lag: samples, no less than the
    delay of G. std: standard deviation of u_hat while no sample is lost. Raises ParameterError, and
    ArithmeticError where rounding is all that is left because of so much noise.
    """

    def __init__(self, model: TransferFunction, noise_std: float, lag: int) -> None:
        check_model(model)
        if lag < model.delay:
            raise ParameterError(
                'estimator.lag', lag, f'must be >= {model.delay}', 'G(z) delays u by as much'
            )
        self.lag = lag
        self.innovation = nan
        self.samples = 0
        state = StateModel(model)
        n = self._n = state.order
        self._scale, weakest = _typical_and_weakest(model)
        self._c = state.c
        self._transition = np.eye(n + 1)
        self._transition[:n, :n], self._transition[:n, n] = state.a, state.b / self._scale
        noise = max(noise_std / self._scale, NOISE_FLOOR * weakest)
        self._noise = noise * noise  # inf where ** would raise
        try:
            self._steady = self._stationary()
        except (linalg.LinAlgError, ValueError):
            raise ArithmeticError(TOO_NOISY) from None
        self._step = np.zeros((n + 1 + lag, n + 1 + lag))  # from k-1 to k before y(k)
        self._step[:n + 1, :n + 1] = self._transition
        self._step[n + 1:, n:-1] = np.eye(lag)
        self._gain = self._gains(self._steady)
        # While no sample is lost, prediction and correction are one map.
        self._closed = self._step - np.outer(self._gain, self._c * self._step[0])
        self._seen = self._c * self._step[0]
        self._after_steady = self._covariance = self._measured(self._steady)
        variance = float(self._after_steady.var[-1])
        if not 0.0 < variance < inf:  # rounding has taken over
            raise ArithmeticError(TOO_NOISY)
        self.std = sqrt(variance)
        self._z: Array = np.zeros(n + 1 + lag)  # x(k), u(k), u(k-1) .. u(k-lag) given y(..k)
        self._steady_after = self._since_loss = LAGS_TO_STEADY * lag

    def _stationary(self) -> _Covariance:
        """Covariances before a measurement when no sample was ever lost."""
        size, lag = self._n + 1, self.lag
        output, process = np.zeros((size, 1)), np.zeros((size, size))
        output[0, 0], process[-1, -1] = self._c, 1.0
        p = linalg.solve_discrete_are(
            self._transition.T, output, process, np.array([[self._noise]])
        )
        covariance = _Covariance(p, np.tile(p[-1], (lag + 1, 1)), np.full(lag + 1, p[-1, -1]))
        for _ in range(lag):
            covariance = self._propagated(self._measured(covariance))
            covariance.p = p
        return covariance

    @property
    def u_hat(self) -> float:
        """u_hat(k - lag) given y(..k)."""
        return float(self._z[-1])

    def newer(self, samples: int) -> float:
        """u_hat(k - lag + samples) given y(..k)."""
        return float(self._z[-1 - samples])

    @property
    def ready(self) -> bool:
        """Whether the start is forgotten and u_hat about as good as without lost samples."""
        if self.samples <= 2 * self.lag:
            return False
        steady = self._covariance is self._after_steady
        return steady or bool(self._covariance.var[-1] <= 4.0 * self.std**2)

    @property
    def x_hat(self) -> Array:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,)."""
        return np.asarray(self._z[:self._n] * self._scale)

    def update(self, y: float | None) -> float:
        """Take in y(k), None if it was lost, and return u_hat(k - lag)."""
        self.samples += 1
        self._since_loss = 0 if y is None else self._since_loss + 1
        if y is not None and self._since_loss > self._steady_after:
            scaled = y / self._scale
            self.innovation = (scaled - float(self._seen @ self._z)) * self._scale
            self._z = self._closed @ self._z + self._gain * scaled
            self._covariance = self._after_steady
            return float(self._z[-1])
        covariance, z = self._propagated(self._covariance), self._step @ self._z
        if y is None:
            self.innovation = nan
            self._covariance = covariance
        else:
            e = y / self._scale - self._c * float(z[0])
            z += self._gains(covariance) * e
            self.innovation = e * self._scale
            self._covariance = self._measured(covariance)
        self._z = z
        return float(z[-1])

    def _gains(self, covariance: _Covariance) -> Array:
        """Gain of [x; u] and of u(k-1) .. u(k-lag), shape (n + 1 + lag,)."""
        c = self._c
        variance = c * c * covariance.p[0, 0] + self._noise
        column = np.concatenate([covariance.p[:, 0], covariance.rows[1:, 0]])
        return np.asarray(column * (c / variance))

    def _measured(self, covariance: _Covariance) -> _Covariance:
        c = self._c
        variance = c * c * covariance.p[0, 0] + self._noise
        row, column = c * covariance.p[0], c * covariance.rows[:, 0]
        return _Covariance(
            covariance.p - np.outer(row, row) / variance,
            covariance.rows - np.outer(column, row) / variance,
            covariance.var - column**2 / variance,
        )

    def _propagated(self, covariance: _Covariance) -> _Covariance:
        p = self._transition @ covariance.p @ self._transition.T
        p[-1, -1] += 1.0
        p = 0.5 * (p + p.T)
        rows, var = np.empty_like(covariance.rows), np.empty_like(covariance.var)
        rows[1:], rows[0] = covariance.rows[:-1] @ self._transition.T, p[-1]
        var[1:], var[0] = covariance.var[:-1], p[-1, -1]
        return _Covariance(p, rows, var)


def _typical_and_weakest(model: TransferFunction) -> tuple[float, float]:
    """Median of |G W| on the unit circle, W = 1/(z - 1), and its minimum in units of that."""
    z = np.exp(1j * np.linspace(0.01, np.pi, 200))
    response = np.abs(model.response(z) / (z - 1.0))
    typical = float(np.median(response))
    return typical, max(float(response.min()) / typical, WEAKEST)
