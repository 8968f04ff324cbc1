"""u from y alone: a fixed-lag Kalman smoother of the unknown input of G.

G may have zeros outside the unit circle, so that 1/G is unstable forwards in time. Looking back
by a few samples makes the inversion stable: an unstable zero z0 is inverted backwards in time,
where it decays like |z0|^-lag. The input is modelled as a random walk u(k+1) = u(k) + w, which
also bounds the inversion where G has zeros on the unit circle.

Reference: B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 7.3.
"""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.state_model import StateModel
from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

INPUT_STEP_STD = 1.0  # of w: only its ratio to the noise of y matters
# Without noise on y the smoother still needs some: this far below the weakest response of y to w.
NOISE_FLOOR = 1e-3


class InputReconstruction:
    """Steady-state fixed-lag smoother: u_hat(k - lag) from y(..k).

    model: G(z). noise_std: standard deviation of the noise on y. lag: samples, >= 1.
    Raises ParameterError where y does not show u (G has a zero at z = 1).
    """

    def __init__(self, model: TransferFunction, noise_std: float, lag: int) -> None:
        self.lag = lag
        self.innovation = nan
        state = StateModel(model)
        n = state.order
        transition = np.block([[state.a, state.b[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
        output = np.zeros(n + 1)
        output[0] = self._c = state.c
        process = np.zeros((n + 1, n + 1))
        process[n, n] = INPUT_STEP_STD**2
        noise = max(noise_std, NOISE_FLOOR * _weakest_response(model)) ** 2
        try:
            p = linalg.solve_discrete_are(
                transition.T, output[:, None], process, np.array([[noise]])
            )
        except (linalg.LinAlgError, ValueError):
            raise ParameterError(
                'plant.numerator', model.numerator.tolist(),
                'gives a G(z) through which u cannot be reconstructed',
                'G(z) must have no zero at z = 1 and no hidden unstable pole',
            ) from None
        variance = float(output @ p @ output) + noise
        self._gain = p @ output / variance
        self._transition = transition
        closed = transition - transition @ np.outer(self._gain, output)
        # Smoothing gains of u(k - i), i = 0 .. lag: cross covariance with the present error.
        rows = np.empty((lag + 1, n + 1))
        rows[0] = p[n]
        for i in range(lag):
            rows[i + 1] = rows[i] @ closed.T
        self._lag_gain = rows @ output / variance
        removed = np.cumsum((rows @ output) ** 2 / variance)
        self.std = float(np.sqrt(max(p[n, n] - removed[-1], 0.0)))
        self._x = np.zeros(n + 1)
        self._window = np.zeros(lag + 1)  # u_hat(k - i) given y(..k)
        self.samples = 0

    @property
    def u_hat(self) -> float:
        """u_hat(k - lag) given y(..k)."""
        return float(self._window[-1])

    def newer(self, samples: int) -> float:
        """u_hat(k - lag + samples) given y(..k)."""
        return float(self._window[-1 - samples])

    @property
    def ready(self) -> bool:
        """Whether enough samples came in for the lag and for the start to be forgotten."""
        return self.samples > 2 * self.lag

    @property
    def x_hat(self) -> Array:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,)."""
        return self._x[:-1]

    def update(self, y: float | None) -> float:
        """Take in y(k), None if it was lost, and return u_hat(k - lag)."""
        window = self._window
        window[1:] = window[:-1].copy()
        x = self._transition @ self._x
        window[0] = x[-1]
        if y is None:
            self.innovation = nan
        else:
            e = y - self._c * float(x[0])
            window += self._lag_gain * e
            x += self._gain * e
            self.innovation = e
        self._x = x
        self.samples += 1
        return float(window[-1])


def _weakest_response(model: TransferFunction) -> float:
    """Smallest |G W| on the unit circle off its zeros, W = 1/(z - 1) being the random walk."""
    z = np.exp(1j * np.linspace(0.01, np.pi, 200))
    response = np.abs(model.response(z) / (z - 1.0)) * INPUT_STEP_STD
    return float(max(response.min(), 1e-6 * np.median(response)))
