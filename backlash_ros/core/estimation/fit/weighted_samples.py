"""The samples of a fit, each counting as much as it tells: as a value or as an interval."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.regression.posterior import Posterior, vague_triangle
from backlash_ros.core.estimation.regression.resolution import Rounding, cells

Array = NDArray[np.float64]


class WeightedSamples:
    """Rows of the regression and y, their weights, and the triangle of all of them.

    vague: weights of priors of the unknowns (p,) that are no information. rounding: of readings
    that are intervals, None while all are values. length: how many samples.
    """

    def __init__(self, vague: Array) -> None:
        self._vague = vague
        self.triangle = vague_triangle(vague)
        self.rounding: Rounding | None = None
        self.length = 0
        self._rows: Array = np.empty((0, len(vague)))
        self._y: Array = np.empty(0)
        self._weights: Array = np.empty(0)  # roots, by which rows and y are multiplied

    @property
    def rows(self) -> Array:
        """Rows of the samples so far, shape (N, p)."""
        return self._rows[:self.length]

    @property
    def weights(self) -> Array:
        """Roots of what the samples so far count for, 0 where y was lost, shape (N,)."""
        return self._weights[:self.length]

    def take(self, rows: Array, y: Array, weights: Array) -> None:
        """Take in y (N,) after each of these v, nan where lost, counting as much as the weights."""
        known = np.isfinite(y)
        weight = weights * known
        root = np.sqrt(weight)
        self._append(rows, np.where(known, y, 0.0), root, weight.sum())

    def begin_rounded(self, rounding: Rounding) -> None:
        """Begin again with all samples, to be taken in for the intervals that they tell."""
        self.rounding, self.length = rounding, 0
        self.triangle = vague_triangle(self._vague)

    def take_rounded(self, rows: Array, y: Array, near: Posterior, likeliest: bool = False) -> None:
        """Take in y (N,), nan where lost, as the intervals that they tell, for outputs near these.

        likeliest: whether these are the likeliest outputs, as they are to remain. Otherwise a
        reading far outside of its interval counts as if it were exact.
        """
        rounding = self.rounding
        assert rounding is not None
        known, expected = np.isfinite(y), rows @ near.mean
        said = cells(
            np.where(known, y - expected, 0.0), rounding.resolution, rounding.noise_std
        )
        information = rounding.information if likeliest else said.information
        # In units in which the noise is that of all readings, each tells as much as on average.
        root = sqrt(rounding.information) * rounding.together
        target = np.where(known, expected + said.score / information, 0.0)
        self._append(rows, target, root * known, np.count_nonzero(known))
        self.triangle.hold_noise(rounding.together)

    def _append(self, rows: Array, y: Array, weights: Array, count: float) -> None:
        first, last = self.length, self.length + len(y)
        if last > len(self._y):
            self._grow(last)
        self._rows[first:last], self._y[first:last] = rows, y
        self._weights[first:last] = weights
        self.triangle.append(rows * weights[:, None], y * weights, float(count))
        self.length = last

    def _grow(self, least: int) -> None:
        """Make room for more samples than now, twice as many as there are."""
        more = max(2 * len(self._y), least) - len(self._y)
        self._rows = np.concatenate([self._rows, np.empty((more, len(self._vague)))])
        self._y, self._weights = (
            np.concatenate([values, np.empty(more)]) for values in (self._y, self._weights)
        )

    def residual(self, posterior: Posterior, since: int = 0) -> Array:
        """Weighted y minus its fit from sample `since` on; 0 where y was lost."""
        part = slice(since, self.length)
        left = self._y[part] - self._rows[part] @ posterior.mean
        return np.asarray(left * self._weights[part])

    def unweighted_residual(self, posterior: Posterior, y: Array) -> Array:
        """The same of all samples without weights. y (N,): of those that do not count."""
        y = np.where(self.weights > 0.0, self._y[:self.length], y)
        return np.asarray(y - self.rows @ posterior.mean)
