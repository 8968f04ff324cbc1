"""Reconstructs u from y alone, and checks whether estimates agree with it.

A fixed-lag Kalman smoother of a random walk u(k+1) = u(k) + w in front of G. Looking back makes the
inversion stable: an unstable zero z0 is inverted backwards in time, where it decays like |z0|^-lag.
Reference: B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, section 7.3.

Estimates of these laws have no standard deviations; they are checked against recent samples: u, or
a linear function of it, is t = theta' phi for the true theta = (m, m c_r, m c_l). With
R = E{phi phi'} over many samples, and phi scaled to E{phi_i^2} = 1, the error of theta_hat obeys

    |theta - theta_hat|^2 <= E{(t - theta_hat' phi)^2} / (smallest eigenvalue of R)
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, nan, sqrt

import numpy as np

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.numerics import riccati
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction

# Square of a signal below which it counts as zero. Its inverse, times the square of any
# measurement, does not overflow.
LEAST_SQUARE = 1e-240
MEMORY = 200  # samples over which means are taken, with fading weights
LEAST_SAMPLES, EVERY = 100, 20  # before the first check, and from one to the next


class InputReconstruction:
    """Fixed-lag smoother: u_hat(k - lag) from y(..k).

    noise_std: of y; the smoother assumes the fraction `smoothed` of it. std: of u_hat while no
    sample is lost. Raises ParameterError, also if the noise is too large for a finite result.
    """

    def __init__(
        self, model: TransferFunction, noise_std: float, lag: int, smoothed: float = 1.0,
    ) -> None:
        if lag < model.delay:
            raise ParameterError(
                'estimator.lag', lag, f'must be >= {model.delay}', 'G(z) delays u by as much')
        self.lag, self.samples = lag, 0
        state = StateModel(model)
        n = state.order
        # y is scaled so that a typical step of u, of size 1, shows in it with size 1: the median of
        # |G W| on the unit circle, W = 1/(z - 1). The noise assumed is at least a fraction of the
        # weakest response, and that at least 1e-4 of the typical one.
        z = np.exp(1j * np.linspace(0.01, np.pi, 200))
        response = np.abs(model.response(z) / (z - 1.0))
        self._scale, self._c = float(np.median(response)), state.c
        weakest = max(float(response.min()) / self._scale, 1e-4)
        noise = max(smoothed * noise_std / self._scale, 1e-3 * weakest)
        self._noise = noise * noise  # inf where ** would raise
        # Transition of z = [x(k), u(k), u(k-1) .. u(k-lag)] from k-1 to k, before y(k).
        self._step = np.zeros((n + 1 + lag, n + 1 + lag))
        self._step[:n, :n], self._step[:n, n] = state.a, state.b / self._scale
        self._step[n, n] = 1.0
        self._step[n + 1:, n:-1] = np.eye(lag)
        try:
            gain, self._covariance = self._corrected(self._stationary())
            variance = float(self._covariance[-1, -1])
        except (np.linalg.LinAlgError, ValueError):
            variance = nan
        if not 0.0 < variance < inf:  # rounding has taken over
            raise ParameterError(
                'estimator.output_noise_std', noise_std, 'is so large that y says nothing of u',
                'give the standard deviation of the noise on y, in the unit of y',
            )
        # While no sample is lost, prediction and correction are one constant linear map.
        by_z = np.append(-self._c * self._step[0], 1.0)  # innovation, from z and y
        self._steady = np.vstack([np.outer(gain, by_z), by_z])
        self._steady[:-1, :-1] += self._step
        self._steady_covariance, self.std = self._covariance, sqrt(variance)
        self._z: Array = np.append(np.zeros(n + 1 + lag), nan)  # given y(..k), and its innovation
        self._since_loss = 4 * lag

    def _stationary(self) -> Array:
        """Stationary covariance of z before a measurement, with no sample lost."""
        unit, step = np.eye(len(self._step)), self._step
        process, output = np.diag(unit[-1 - self.lag]), self._c * unit[0]
        p = riccati(step.T, output / sqrt(self._noise), process)
        for _ in range(100):  # filter steps remove rounding errors that matter with little noise
            gain = p @ output / (output @ p @ output + self._noise)
            rest = unit - np.outer(gain, output)
            p = step @ (rest @ p @ rest.T + self._noise * np.outer(gain, gain)) @ step.T + process
        return p

    @property
    def u_hat(self) -> float:
        return self._z.item(-2)

    @property
    def innovation(self) -> float:
        return self._z.item(-1) * self._scale

    def newer(self, samples: int) -> float:
        """u_hat(k - lag + samples) given y(..k)."""
        return self._z.item(-2 - samples)

    @property
    def ready(self) -> bool:
        """Whether the initial transient is over and lost samples have not spoilt u_hat."""
        return self.samples > 2 * self.lag and self._covariance.item(-1) <= 4.0 * self.std**2

    @property
    def x_hat(self) -> list[float]:
        """State of G given y(..k) in the coordinates of StateModel, (n,)."""
        x: list[float] = (self._z[:-2 - self.lag] * self._scale).tolist()
        return x

    def update(self, y: float | None) -> float:
        """Process y(k), None if it was lost, and return u_hat(k - lag)."""
        self.samples += 1
        self._since_loss = 0 if y is None else self._since_loss + 1
        # The covariance is stationary again 4 lags after a lost sample.
        if y is not None and self._since_loss > 4 * self.lag:
            self._covariance = self._steady_covariance
            self._z[-1] = y / self._scale
            self._z = self._steady @ self._z
            return self.u_hat
        self._covariance = self._propagated(self._covariance)
        z, e = self._step @ self._z[:-1], nan
        if y is not None:
            e = y / self._scale - self._c * z.item(0)
            gain, self._covariance = self._corrected(self._covariance)
            z += gain * e
        self._z = np.append(z, e)
        return self.u_hat

    def _corrected(self, p: Array) -> tuple[Array, Array]:
        """Kalman gain for a measurement with prior covariance p, and the covariance after it."""
        gain: Array = p[:, 0] * (self._c / (self._c**2 * p[0, 0] + self._noise))
        return gain, p - np.outer(gain, self._c * p[0])

    def _propagated(self, p: Array) -> Array:
        p = self._step @ p @ self._step.T
        p[-1 - self.lag, -1 - self.lag] += 1.0
        return np.asarray(0.5 * (p + p.T))


class Agreement:
    """Judges estimates by means of the products of phi and t.

    status: TRACKING while neither a theta that explains the samples, nor the newest estimate,
    differs from the one judged last by more than a tenth of the crossings' contribution to t;
    INCONSISTENT if the samples require a negative slope; ACQUIRING otherwise.
    """

    def __init__(self) -> None:
        self.status = Status.ACQUIRING
        self._samples = 0
        self._rows: list[Sequence[float]] = []  # (phi, t) since the means were last updated
        self._products = np.zeros((4, 4))  # means of (phi, t)(phi, t)'
        # Products judged last, weights of their errors, largest weighted sum of squares allowed.
        self._judged, self._weights, self._most = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0

    def judged(self, new: Estimate, row: Sequence[float]) -> Estimate:
        """The estimate with its status. row: the three elements of phi, and t, of this sample."""
        theta = new.m, new.m * new.c_r, new.m * new.c_l
        self._rows.append(row)
        if len(self._rows) == EVERY:
            self._samples += EVERY
            rows, self._rows = np.array(self._rows), []
            share = EVERY / min(self._samples, MEMORY)
            self._products += share * (rows.T @ rows / EVERY - self._products)
            if self._samples >= LEAST_SAMPLES:
                self.status = self._judge(theta)
        elif self.status is Status.TRACKING:
            moved = zip(theta, self._judged, self._weights, strict=True)
            if sum((weight * (now - then)) ** 2 for now, then, weight in moved) > self._most:
                self.status = Status.ACQUIRING
        return new if new.status is self.status else replace(new, status=self.status)

    def _judge(self, theta: tuple[float, float, float]) -> Status:
        size = np.sqrt(np.diag(self._products)[:3])
        if float(size.min()) ** 2 <= LEAST_SQUARE:
            return Status.ACQUIRING
        eigenvalues, vectors = np.linalg.eigh(self._products[:3, :3] / np.outer(size, size))
        least, largest = float(eigenvalues[0]), float(eigenvalues[-1])
        # As small as rounding errors: the samples do not determine theta.
        if least <= 1e-12 * largest:
            return Status.ACQUIRING
        most = 0.1**2 * float((theta[1] * size[1]) ** 2 + (theta[2] * size[2]) ** 2)
        if self._mean_square(np.array(theta)) <= least * most:
            self._judged, self._most, self._weights = theta, most, tuple(size.tolist())
            return Status.TRACKING
        # R^-1 from R = Q diag(l) Q', positive definite in spite of rounding.
        inverse = (vectors / eigenvalues) @ vectors.T
        best = inverse @ (self._products[:3, 3] / size) / size
        variance = self._mean_square(best) * float(inverse[0, 0])
        deviation = sqrt(variance / min(self._samples, MEMORY)) / float(size[0])
        return Status.INCONSISTENT if float(best[0]) < -5.0 * deviation else Status.ACQUIRING

    def _mean_square(self, theta: Array) -> float:
        """Mean of (t - theta' phi)^2."""
        weights = np.append(-theta, 1.0)
        return max(float(weights @ self._products @ weights), 0.0)
