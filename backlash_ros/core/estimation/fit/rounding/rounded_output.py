"""The G of low order that readings which were rounded speak for, given u (family.py)."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit.low_order.family import Family
from backlash_ros.core.estimation.fit.low_order.low_order import low_order
from backlash_ros.core.estimation.fit.low_order.output_error import OutputError
from backlash_ros.core.estimation.fit.rounding.ascent import Place, climbed, climbed_at
from backlash_ros.core.estimation.regression.resolution import Rounding, cells
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

# Of the resolution. Nothing is published that would be too sure for it.
LEAST_NOISE = 1.0 / 64.0


class _Readings:
    """What readings y (N,) tell, nan where they were lost."""

    def __init__(self, y: Array, resolution: float) -> None:
        self._known, self._resolution = np.isfinite(y), resolution
        self._y = np.where(self._known, y, 0.0)
        # Of a free response, which may be as large as all that was read.
        self.vague = 1.0 / (float(self._y @ self._y) + resolution**2)

    def place(
        self, x: Array, prior: Array, output: Array, slopes: Array, noise_std: float,
    ) -> Place:
        """At x (p,), with independent priors (p,) and slopes (p, N) of the output (N,)."""
        said = cells(self._y - output, self._resolution, noise_std)
        value = float(said.likelihood @ self._known) - 0.5 * float(prior * x @ x)
        gradient = slopes @ (said.score * self._known) - prior * x
        precision = (slopes * (said.information * self._known)) @ slopes.T + np.diag(prior)
        return Place(value, gradient, precision)

    def projected(self, signals: Array, output: Array) -> Array:
        """Coefficients of signals (p, N) with which these outputs lack least of the readings."""
        left = (self._y - output) * self._known
        return np.asarray(np.linalg.lstsq((signals * self._known).T, left, rcond=None)[0])


class _LowOrder:
    """xi of the family, and the coefficients of the free responses."""

    def __init__(
        self, family: Family, problem: OutputError, delay: int, readings: _Readings,
    ) -> None:
        self._family, self._problem, self._delay = family, problem, delay
        self._readings = readings
        self.size = family.prior.shape[1]

    def with_free_responses(self, xi: Array) -> Array:
        """x with this xi."""
        parts = self._parts(xi)
        assert parts is not None
        _, answer, free = parts
        return np.append(xi, self._readings.projected(free, self._problem.newest(answer)))

    def at(self, x: Array, noise_std: float) -> Generator[None, None, Place]:
        """The log-posterior at x (k + n,)."""
        xi, held = x[:self.size], x[self.size:]
        parts = self._parts(xi)
        yield
        if parts is None:
            return Place(-np.inf, np.zeros(len(x)), np.eye(len(x)))
        a, answer, free = parts
        slopes = self._problem.unweighted_slopes(a, answer, self._delay, self._family.taps)
        prior = np.append(np.ones(self.size), np.full(len(held), self._readings.vague))
        return self._readings.place(
            x, prior, self._problem.newest(answer) + held @ free,
            np.concatenate([self._family.prior.T @ slopes, free]), noise_std,
        )

    def _parts(self, xi: Array) -> tuple[Array, Array, Array] | None:
        coefficients = self._family.coefficients(xi)
        if coefficients is None:
            return None
        b, a = coefficients
        poles = self._problem.poles(a)
        return a, self._problem.response(b, poles, self._delay), self._problem.free(poles)


class _Given:
    """Gain and free responses of a G that is given."""

    def __init__(self, model: TransferFunction, problem: OutputError, readings: _Readings) -> None:
        poles = np.trim_zeros(model.denominator, 'b')
        answer = problem.newest(problem.response(model.numerator[1:], poles, 1))
        self._signals = np.concatenate([answer[None], problem.free(poles)])
        self._readings = readings

    @property
    def start(self) -> Array:
        """Gain and coefficients that come closest."""
        return self._readings.projected(self._signals, np.zeros(self._signals.shape[1]))

    def at(self, x: Array, noise_std: float) -> Generator[None, None, Place]:
        """The log-posterior at x (1 + n,)."""
        prior = np.append(0.0, np.full(len(x) - 1, self._readings.vague))
        yield
        return self._readings.place(x, prior, x @ self._signals, self._signals, noise_std)


def likelier_by_intervals(
    family: Family, problem: OutputError, present: TransferFunction, y: Array, rounding: Rounding,
    by: float,
) -> Generator[None, None, TransferFunction | None]:
    """The likeliest G of the family, None unless it is likelier than the present one.

    y: of the problem, shape (N,), nan where lost. by: log-likelihood by which it has to be.
    """
    xi, delay = yield from low_order(family, problem, shifts=(0,))
    readings = _Readings(y, rounding.resolution)
    unknown = _LowOrder(family, problem, delay, readings)
    x, value, noise_std = yield from climbed(
        unknown, unknown.with_free_responses(xi), rounding.noise_std,
        LEAST_NOISE * rounding.resolution,
    )
    xi = x[:unknown.size]
    given = _Given(present, problem, readings)
    _, of_present = yield from climbed_at(given, given.start, noise_std)
    # Both without a prior of what G is.
    if value + 0.5 * float(xi @ xi) <= of_present + by:
        return None
    return family.transfer_function(xi, delay, problem)
