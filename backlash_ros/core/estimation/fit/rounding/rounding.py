"""The fit of readings that were rounded, by the intervals that they tell (resolution.py).

It begins with the least-squares fit, keeps its priors, and makes the same Gauss-Newton steps in the
gap (relabelling.py).
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import AS_GOOD, MOVED
from backlash_ros.core.estimation.fit.learned_error import moved_error
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.relabelling import RELABELLINGS, Fitted, labelled
from backlash_ros.core.estimation.fit.rounding.ascent import Place, climbed, climbed_at
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.regression.posterior import Posterior
from backlash_ros.core.estimation.regression.resolution import Rounding, cells, resolution_of

Array = NDArray[np.float64]

# Noise beside the rounding that is tried, as shares of the resolution. With the first one readings
# tell what they tell as values; edges of real readings are hardly sharper than the last one.
MOST_NOISE, LEAST_NOISE = 1.0 / 4.0, 1.0 / 64.0


class _Unknowns:
    """All unknowns of a fit, given readings y (N,) with this resolution, nan where lost.

    In coordinates z in which the posterior of the least-squares fit is standard normal: x = mean +
    root z. What that fit knows besides its samples is the prior. rows: unweighted, shape (N, p).
    """

    def __init__(
        self, fit: WindowFit, y: Array, known: Posterior, resolution: float, pace: Pace,
    ) -> None:
        self._known, self._resolution, self._pace = np.isfinite(y), resolution, pace
        self._y = np.where(self._known, y, 0.0)
        self.rows, weights = fit.samples.rows, fit.samples.weights
        self._mean = known.mean
        # Of the correlations: the units of the unknowns differ by many orders of magnitude.
        std = np.sqrt(np.diag(known.cov))
        units = np.where(std > 0.0, std, 1.0)
        shares, axes = np.linalg.eigh(known.cov / np.outer(units, units))
        self._root = units[:, None] * axes * (np.sqrt(np.maximum(shares, 0.0)) * known.noise_std)
        by = (self.rows * weights[:, None]) @ self._root / known.noise_std
        shares, axes = np.linalg.eigh(np.eye(by.shape[1]) - by.T @ by)
        self._prior = (axes * np.maximum(shares, 0.0)) @ axes.T
        left = (self._y - self.rows @ self._mean) * weights
        self._pull = by.T @ left / -known.noise_std

    @property
    def start(self) -> Array:
        """z of the least-squares fit."""
        return np.zeros(len(self._pull))

    def unknowns(self, z: Array) -> Array:
        """x (p,)."""
        return np.asarray(self._mean + self._root @ z)

    def at(self, z: Array, noise_std: float) -> Generator[None, None, Place]:
        """The log-posterior at z (p,)."""
        prior = self._prior @ z
        value = float(self._pull @ z - 0.5 * z @ prior)
        gradient, precision = self._pull - prior, self._prior.copy()
        x = self.unknowns(z)
        for part in _pieces(len(self._y), len(z), self._pace):
            rows, known = self.rows[part], self._known[part]
            said = cells(self._y[part] - rows @ x, self._resolution, noise_std)
            by = rows @ self._root
            value += float(said.likelihood @ known)
            gradient += by.T @ (said.score * known)
            precision += by.T @ (by * (said.information * known)[:, None])
            yield
        return Place(value, gradient, precision)


def with_rounding(
    v: Array, y: Array, result: Fitted, pace: Pace,
) -> Generator[None, None, Fitted]:
    """The fit of v (N,) and y (N,) as intervals, where y was rounded and its noise is smaller.

    That of values stays where the intervals lead astray, as few of them may, or a v that never
    acted.
    """
    resolution = resolution_of(y)
    if resolution == 0.0 or not result.solution.m > 0.0 or result.fit.gap_spread > 0.0:
        return result
    of_values = result
    for _ in range(RELABELLINGS):
        result = yield from _as_intervals(v, y, result, resolution, pace)
        fit, solution, decided = result
        error = moved_error(fit, solution)
        if error is fit.around.error or fit.samples.rounding is None:
            break
        # As intervals the readings tell another G than as values.
        around, start = fit.around._replace(error=error), result.beginning(v)
        result = yield from labelled(v, y, around, start, solution.m, pace)
        result = result._replace(decided=decided)
    explains = result.solution.rms <= AS_GOOD * of_values.solution.rms
    return result if explains else of_values


def _as_intervals(
    v: Array, y: Array, result: Fitted, resolution: float, pace: Pace,
) -> Generator[None, None, Fitted]:
    """The fit by intervals around the G of a fit by values."""
    fit, known = result.fit, result.solution.posterior
    problem = _Unknowns(fit, y, known, resolution, pace)
    most = MOST_NOISE * resolution
    z, _, noise_std = yield from climbed(problem, problem.start, most, LEAST_NOISE * resolution)
    if noise_std == most:
        return result
    rounding, fit = Rounding(resolution, noise_std, known.noise_std), fit.emptied()
    for _ in range(RELABELLINGS):
        most_likely = replace(known, mean=problem.unknowns(z))
        yield from _read(fit, problem, y, rounding, most_likely, pace)
        result = Fitted(fit, fit.solve(), result.decided)
        solution = result.solution
        # Labels that are closer than this would not be made again either.
        if not solution.m > 0.0 or (
            abs(solution.gap - fit.start.gap) <= 0.5 * MOVED * solution.std_gap
        ):
            break
        fit = fit.relabelled(result.beginning(v), solution.m)
        problem.rows = yield from _columns(fit, v, y, pace)
        z, _ = yield from climbed_at(problem, z, noise_std)
    return result


def _read(
    fit: WindowFit, problem: _Unknowns, y: Array, rounding: Rounding, most: Posterior, pace: Pace,
) -> Generator[None, None, None]:
    """Let a fit take in all readings with the likeliest unknowns."""
    fit.samples.begin_rounded(rounding)
    for part in _pieces(len(y), fit.layout.unknowns, pace):
        fit.samples.take_rounded(problem.rows[part], y[part], most, likeliest=True)
        yield


def _columns(
    fit: WindowFit, v: Array, y: Array, pace: Pace,
) -> Generator[None, None, Array]:
    """Columns of a fit for all samples, shape (N, p), made in pieces."""
    columns = []
    for part in _pieces(len(v), fit.layout.unknowns, pace):
        columns.append(fit.columns(v[part], y[part]))
        yield
    return np.concatenate(columns)


def _pieces(samples: int, unknowns: int, pace: Pace) -> Iterator[slice]:
    """All samples, in pieces."""
    step = pace.pieces(unknowns)
    return (slice(first, first + step) for first in range(0, samples, step))
