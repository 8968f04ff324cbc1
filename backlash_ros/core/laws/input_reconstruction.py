"""u from y alone: a fixed-lag Kalman smoother of the unknown input of G.

G may have zeros outside the unit circle, so that 1/G is unstable forwards in time. Looking back
by a few samples makes the inversion stable: an unstable zero z0 is inverted backwards in time,
where it decays like |z0|^-lag. The input is modelled as a random walk u(k+1) = u(k) + w, which
also bounds the inversion where G has zeros on the unit circle.

Reference: B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 7.3.
"""

from __future__ import annotations

from math import inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.model_check import check_model
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

Array = NDArray[np.float64]


class InputReconstruction:
    """Fixed-lag smoother: u_hat(k - lag) from y(..k).

    model: G(z). noise_std: standard deviation of the noise on y. lag: samples, no less than the
    delay of G. smoothed: share of the noise that is smoothed away. std: standard deviation of u_hat
    while no sample is lost. Raises ParameterError, also where so much noise leaves nothing but
    rounding.
    """

    def __init__(
        self, model: TransferFunction, noise_std: float, lag: int, smoothed: float = 1.0,
    ) -> None:
        check_model(model)
        if lag < model.delay:
            raise ParameterError(
                'estimator.lag', lag, f'must be >= {model.delay}', 'G(z) delays u by as much'
            )
        self.lag = lag
        self.innovation = nan
        self.samples = 0
        state = StateModel(model)
        n = state.order
        # y is scaled so that a typical step of u, of size 1, shows in it with size 1: the median of
        # |G W| on the unit circle, W = 1/(z - 1). The least noise that is assumed is a share of the
        # weakest response, which counts as no weaker than 1e-4 of the typical one.
        z = np.exp(1j * np.linspace(0.01, np.pi, 200))
        response = np.abs(model.response(z) / (z - 1.0))
        self._scale = float(np.median(response))
        weakest = max(float(response.min()) / self._scale, 1e-4)
        self._c = state.c
        noise = max(smoothed * noise_std / self._scale, 1e-3 * weakest)
        self._noise = noise * noise  # inf where ** would raise
        # z = [x(k), u(k), u(k-1) .. u(k-lag)], from k-1 to k before y(k).
        self._step = np.zeros((n + 1 + lag, n + 1 + lag))
        self._step[:n, :n], self._step[:n, n] = state.a, state.b / self._scale
        self._step[n, n] = 1.0
        self._step[n + 1:, n:-1] = np.eye(lag)
        try:
            steady = self._stationary()
        except (np.linalg.LinAlgError, ValueError):
            variance = nan
        else:
            gain, self._covariance = self._gain_of(steady), self._measured(steady)
            variance = float(self._covariance[-1, -1])
        if not 0.0 < variance < inf:  # rounding has taken over
            raise ParameterError(
                'estimator.output_noise_std', noise_std, 'is so large that y says nothing of u',
                'give the standard deviation of the noise on y, in the unit of y',
            )
        # While no sample is lost, prediction and correction are one map.
        closed = self._step - np.outer(gain, self._c * self._step[0])
        self._steady = closed, gain, self._covariance
        self.std = sqrt(variance)
        self._z: Array = np.zeros(n + 1 + lag)  # given y(..k)
        self._since_loss = 4 * lag

    def _stationary(self) -> Array:
        """Covariance of z before a measurement when no sample was ever lost."""
        from scipy import linalg  # where it is needed: 31 MB

        size = self._order + 1
        output, process = np.zeros((size, 1)), np.zeros((size, size))
        output[0, 0], process[-1, -1] = self._c, 1.0
        p = linalg.solve_discrete_are(
            self._step[:size, :size].T, output, process, np.array([[self._noise]])
        )
        as_if_resting = np.minimum(np.arange(size + self.lag), size - 1)
        covariance: Array = p[np.ix_(as_if_resting, as_if_resting)]
        for _ in range(self.lag):
            covariance = self._propagated(self._measured(covariance))
            covariance[:size, :size] = p
        return covariance

    @property
    def _order(self) -> int:
        return len(self._step) - 1 - self.lag

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
        steady = self._covariance is self._steady[2]
        return steady or bool(self._covariance[-1, -1] <= 4.0 * self.std**2)

    @property
    def x_hat(self) -> Array:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,)."""
        return np.asarray(self._z[:self._order] * self._scale)

    def update(self, y: float | None) -> float:
        """Take in y(k), None if it was lost, and return u_hat(k - lag)."""
        self.samples += 1
        self._since_loss = 0 if y is None else self._since_loss + 1
        # Samples after a lost one until the covariance is stationary again.
        if y is not None and self._since_loss > 4 * self.lag:
            scaled, (closed, gain, self._covariance) = y / self._scale, self._steady
            self.innovation = (scaled - float((self._c * self._step[0]) @ self._z)) * self._scale
            self._z = closed @ self._z + gain * scaled
            return float(self._z[-1])
        covariance, self._z = self._propagated(self._covariance), self._step @ self._z
        if y is None:
            self.innovation = nan
        else:
            e = y / self._scale - self._c * float(self._z[0])
            self.innovation = e * self._scale
            self._z += self._gain_of(covariance) * e
            covariance = self._measured(covariance)
        self._covariance = covariance
        return float(self._z[-1])

    def _gain_of(self, p: Array) -> Array:
        return np.asarray(p[:, 0] * (self._c / (self._c**2 * p[0, 0] + self._noise)))

    def _measured(self, p: Array) -> Array:
        return p - np.outer(self._gain_of(p), self._c * p[0])

    def _propagated(self, p: Array) -> Array:
        p = self._step @ p @ self._step.T
        p[self._order, self._order] += 1.0
        return np.asarray(0.5 * (p + p.T))
