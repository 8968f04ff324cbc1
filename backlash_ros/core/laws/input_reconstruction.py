"""u from y alone, and the laws that learn from it.

A fixed-lag Kalman smoother of a random walk u(k+1) = u(k) + w in front of G. Looking back makes the
inversion stable: an unstable zero z0 is inverted backwards in time, where it decays like |z0|^-lag.
Reference: B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 7.3.
"""

from collections import deque
from math import inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds, Estimate
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.agreement import Agreement
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction, check_model

Array = NDArray[np.float64]

STROKE = 8  # samples to either side over which u moves on in one direction


class InputReconstruction:
    """Fixed-lag smoother: u_hat(k - lag) from y(..k).

    noise_std: standard deviation of the noise on y. lag: samples, no less than the delay of G.
    smoothed: share of the noise that is smoothed away. std: standard deviation of u_hat while no
    sample is lost. Raises ParameterError, also where so much noise leaves nothing but rounding.
    """

    def __init__(
        self, model: TransferFunction, noise_std: float, lag: int, smoothed: float = 1.0,
    ) -> None:
        check_model(model)
        if lag < model.delay:
            raise ParameterError(
                'estimator.lag', lag, f'must be >= {model.delay}', 'G(z) delays u by as much')
        self.lag, self.innovation, self.samples = lag, nan, 0
        state = StateModel(model)
        n = state.order
        # y is scaled so that a typical step of u, of size 1, shows in it with size 1: the median of
        # |G W| on the unit circle, W = 1/(z - 1). The least noise that is assumed is a share of the
        # weakest response, which counts as no weaker than 1e-4 of the typical one.
        z = np.exp(1j * np.linspace(0.01, np.pi, 200))
        response = np.abs(model.response(z) / (z - 1.0))
        self._scale, self._c = float(np.median(response)), state.c
        weakest = max(float(response.min()) / self._scale, 1e-4)
        noise = max(smoothed * noise_std / self._scale, 1e-3 * weakest)
        self._noise = noise * noise  # inf where ** would raise
        # z = [x(k), u(k), u(k-1) .. u(k-lag)], from k-1 to k before y(k).
        self._step = np.zeros((n + 1 + lag, n + 1 + lag))
        self._step[:n, :n], self._step[:n, n] = state.a, state.b / self._scale
        self._step[n, n] = 1.0
        self._step[n + 1:, n:-1] = np.eye(lag)
        variance = nan
        try:
            before = self._stationary(n + 1)
            gain, self._covariance = self._gain_of(before), self._measured(before)
            variance = float(self._covariance[-1, -1])
        except (np.linalg.LinAlgError, ValueError):
            pass
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

    def _stationary(self, size: int) -> Array:
        """Covariance of z before a measurement when no sample was ever lost; size: of (x, u)."""
        from scipy import linalg  # where it is needed: 31 MB

        output, process = np.zeros((size, 1)), np.zeros((size, size))
        output[0, 0], process[-1, -1] = self._c, 1.0
        p = linalg.solve_discrete_are(
            self._step[:size, :size].T, output, process, np.array([[self._noise]]))
        as_if_resting = np.minimum(np.arange(size + self.lag), size - 1)
        covariance: Array = p[np.ix_(as_if_resting, as_if_resting)]
        for _ in range(self.lag):
            covariance = self._propagated(self._measured(covariance))
            covariance[:size, :size] = p
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
        return self.samples > 2 * self.lag and bool(self._covariance[-1, -1] <= 4.0 * self.std**2)

    @property
    def x_hat(self) -> Array:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,)."""
        return np.asarray(self._z[:-1 - self.lag] * self._scale)

    def update(self, y: float | None) -> float:
        """Take in y(k), None if it was lost, and return u_hat(k - lag)."""
        self.samples += 1
        self._since_loss = 0 if y is None else self._since_loss + 1
        # Samples after a lost one until the covariance is stationary again.
        if y is not None and self._since_loss > 4 * self.lag:
            scaled, (closed, gain, self._covariance) = y / self._scale, self._steady
            self.innovation = (scaled - float((self._c * self._step[0]) @ self._z)) * self._scale
            self._z = closed @ self._z + gain * scaled
            return self.u_hat
        self._covariance = self._propagated(self._covariance)
        self._z, self.innovation = self._step @ self._z, nan
        if y is not None:
            e = y / self._scale - self._c * float(self._z[0])
            self.innovation = e * self._scale
            self._z += self._gain_of(self._covariance) * e
            self._covariance = self._measured(self._covariance)
        return self.u_hat

    def _gain_of(self, p: Array) -> Array:
        return np.asarray(p[:, 0] * (self._c / (self._c**2 * p[0, 0] + self._noise)))

    def _measured(self, p: Array) -> Array:
        return p - np.outer(self._gain_of(p), self._c * p[0])

    def _propagated(self, p: Array) -> Array:
        p = self._step @ p @ self._step.T
        p[-1 - self.lag, -1 - self.lag] += 1.0
        return np.asarray(0.5 * (p + p.T))


class LaggedLaw(Law):
    """Learns from u reconstructed some samples late, and what was applied when it acted."""

    def __init__(
        self, initial: Estimate, bounds: Bounds, f_bounds: tuple[float, float],
        reconstruction: InputReconstruction,
    ) -> None:
        self.estimate, self._bounds, self._f_bounds = initial, bounds, f_bounds
        self._reconstruction = reconstruction
        self._applied: deque[Interval] = deque(maxlen=reconstruction.lag)
        self._past: deque[float] = deque([0.0, 0.0], maxlen=STROKE + 1)
        self._agreement = Agreement()

    @property
    def u_hat(self) -> float:
        """Reconstruction of u, `lag` samples old."""
        return self._reconstruction.u_hat

    @property
    def x_hat(self) -> Array:
        return self._reconstruction.x_hat

    @property
    def innovation(self) -> float:
        return self._reconstruction.innovation

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k) and learn from the sample that the reconstruction has reached."""
        u = self._reconstruction.update(y)
        self._past.append(u)
        self._applied.append(interval)  # the newest carried u(k-1), the oldest u(k-lag)
        if not (self.adapting and self._reconstruction.ready):
            return
        past, rising = self._applied[0], self._rising(u)
        self.estimate = self._learned(u, past, rising)
        if rising is not None:
            row = (past.v, -1.0, 0.0, u) if rising else (past.v, 0.0, -1.0, u)
            self.estimate = self._agreement.judged(self.estimate, row)

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        """The estimate after u, and what was applied with it."""
        raise NotImplementedError

    def _rising(self, u: float) -> bool | None:
        """Whether u moves on the right line (True) or the left one; None where it may rest.

        u rises only on the right line and falls only on the left one, so that no wrong side can
        lock in. It counts as moving on by two deviations of its error, as smoothing rounds the
        corners, and at no less than a quarter of the mean pace of the stroke.
        """
        ahead, behind = self._reconstruction.newer(STROKE) - u, u - self._past[0]
        step, rising = u - self._past[-2], True
        if min(ahead, behind, step) < 0.0:
            ahead, behind, step, rising = -ahead, -behind, -step, False
        slowest = min(ahead, behind)
        resting = slowest <= 2.0 * self._reconstruction.std or step < 0.25 * slowest / STROKE
        return None if resting else rising
