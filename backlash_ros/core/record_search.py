"""Exact fit of the first samples: which gap, and where in it the plant was when v first moved.

The play operator makes u known up to two factors once two numbers are given: the gap g and the
reach q before the first sample, where u = m (q - c_r). Then

    y = G[q(k)] m - G[1] m c_r + (free response of G),  q(k) = clamp(q(k-1), v(k), v(k) + g)

is linear in m, m c_r and the state at the start. Nothing has to be left out, while the Kalman
filters of a GapBank know nothing of u, and so of x, until v has swung over the whole gap.

A grid over (g, q) finds the basins, ever smaller ones the optimum in each. Every grid follows a
line of best reaches q(g), as both together are often known much better than one by one. Unlike
record_fit.py, which fits a whole record once, it takes the delay and the sign of m as known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

GAPS, REACHES = 24, 9  # of the first grid
RATIO = 1.2  # between neighbouring gaps of the first grid
WIDEST = 2.5  # in swings of v: what lies beyond cannot be told from this
BASINS = 4  # of the first grid that are looked into
HALF = 3  # gaps and reaches of the other grids to either side of the centre
SHRINK, WIDEN = 0.2, 1.7  # most and least that distances change from one grid to the next
LARGEST_WIDTH = 0.1  # between reaches, in gaps
MOST_STAGES = 12
STEEP = 1.0  # log-likelihood by which the reaches beside the best one of the last grid fall behind
NEAREST, NEAR = 1.5, 5.0  # the same for its outermost gaps
FINEST = 1e-9  # relative distance between gaps
TINY = 1e-300  # keeps a division finite
INDIFFERENT = 0.01  # squared residual, in variances of the noise, that makes no difference
MISFIT = 4.0  # standard deviations by which the sum of squares may exceed its mean


@dataclass(frozen=True)
class RecordOptimum:
    """What fits best: a gap and m, their deviations; gaps and reaches (H,) of the last grid.

    reach_per_gap: by how much the best reach changes with the gap. misfit: by how many of its
    standard deviations the sum of squared residuals is too large.
    """

    gap: float
    std_gap: float
    m: float
    std_m: float
    reach: float
    reach_per_gap: float
    gaps: Array
    reaches: Array
    misfit: float


@dataclass(frozen=True)
class _Grid:
    gaps: Array  # (G,), ascending
    reaches: Array  # (G, R)
    ratio: float  # between neighbouring gaps
    width: float  # between neighbouring reaches, in gaps


@dataclass(frozen=True)
class _Line:
    """The best reach for each gap of a grid."""

    grid: _Grid
    reaches: Array  # (G,)
    squares: Array  # (G,), sums of squared residuals
    m: Array  # (G,)
    rise: float  # of the squares from the best reach of the best gap to those beside it

    @property
    def best(self) -> int:
        return int(self.squares.argmin())

    @property
    def least(self) -> float:
        return float(self.squares[self.best])

    @property
    def inside(self) -> bool:
        return 0 < self.best < len(self.squares) - 1

    @property
    def fall(self) -> float:
        """How much larger the squares of the first or the last gap are than the least."""
        return float(self.squares[[0, -1]].max()) - self.least


class RecordSearch:
    """The search over one record, grid after grid."""

    def __init__(
        self, model: TransferFunction, y: Array, v: Array, noise_std: float, widest: float,
        hint: RecordOptimum | None = None,
    ) -> None:
        """y, v: shape (N,), v acted in the interval before y, which is nan where it was lost.

        hint: what fitted fewer of these samples best.
        """
        self.optimum: RecordOptimum | None = None
        self._hint = hint
        self._model, self._v = model, v.copy()
        self._heard = np.flatnonzero(np.isfinite(y))
        self._variance = noise_std**2
        self._freedom = len(self._heard) - model.order - 4
        free = lfilter([1.0], model.denominator, np.eye(model.order, len(v)))
        known = np.vstack([free, self._response(np.ones((1, len(v))))])[:, self._heard]
        self._basis = np.linalg.qr(known.T)[0]
        self._y = self._unknown_part(y[self._heard])
        self._lowest = float(v[0])
        self._top = min(widest, WIDEST * float(np.ptp(v)))
        self._grids: list[_Grid] = []
        self._tried: list[_Line] = []
        self._stages = 0

    def advance(self) -> bool:
        """Evaluate the next grids; return whether the search has ended."""
        if self._freedom < 1:
            return True
        self._stages += 1
        if self._stages == 1:
            self._grids = self._basins()
            return not self._grids
        lines = self._evaluate(self._grids)
        self._tried += lines
        leader = min(lines, key=lambda line: line.least)
        if leader.least == inf:
            return True  # nothing with m > 0 fits
        rise, fall = self._likelihood(leader.rise), self._likelihood(leader.fall)
        found = abs(leader.best - HALF) <= 1 and rise < STEEP and NEAREST <= fall <= NEAR
        if self._stages == MOST_STAGES or (found and self._misfit(leader) < MISFIT):
            self._finish(leader)
            return True
        self._grids = [self._zoom(line) for line in lines]
        return False

    def _likelihood(self, squares: float) -> float:
        return squares / (2.0 * self._variance)

    def _misfit(self, line: _Line) -> float:
        return (line.least / self._variance - self._freedom) / sqrt(2.0 * self._freedom)

    def _finish(self, leader: _Line) -> None:
        """Take the best, with deviations from how far those lie off that are about as likely."""
        squares = np.concatenate([line.squares for line in self._tried])
        behind = (squares - leader.least) / self._variance  # twice the log-likelihood
        near = behind < 2.0 * NEAR
        scale = np.sqrt(np.maximum(behind[near], 1.0))
        gaps = np.concatenate([line.grid.gaps for line in self._tried])[near]
        slopes = np.concatenate([line.m for line in self._tried])[near]
        gap, m = float(leader.grid.gaps[leader.best]), float(leader.m[leader.best])
        self.optimum = RecordOptimum(
            gap=gap, std_gap=float((np.abs(gaps - gap) / scale).max()),
            m=m, std_m=float((np.abs(slopes - m) / scale).max()),
            reach=float(leader.reaches[leader.best]),
            reach_per_gap=_reach_per_gap(leader, self._variance),
            gaps=leader.grid.gaps, reaches=leader.reaches, misfit=self._misfit(leader),
        )

    def _basins(self) -> list[_Grid]:
        """Grids around the best local minima of the first one, and around the hint."""
        gaps = np.asarray(self._top * RATIO ** np.arange(1.0 - GAPS, 1.0), dtype=np.float64)
        shares = np.linspace(0.0, 1.0, REACHES)
        grid = _Grid(gaps, self._lowest + gaps[:, None] * shares, RATIO, float(shares[1]))
        squares, slopes = (
            values.reshape(grid.reaches.shape)
            for values in self._squares(grid.gaps.repeat(REACHES), grid.reaches.ravel())
        )
        self._tried.append(_line(grid, squares, slopes, self._variance))
        padded = np.pad(squares, 1, constant_values=inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        lowest = np.isfinite(squares) & (squares <= around.min(axis=(2, 3)))
        where = np.argwhere(lowest)
        order = np.argsort(squares[lowest])[:BASINS]
        grids = [
            self._grid_around(
                float(grid.gaps[i]), float(grid.reaches[i, j]), 0.0, RATIO ** (1.0 / HALF),
                grid.width / HALF,
            ) for i, j in where[order]
        ]
        if self._hint is not None:
            hint = self._hint
            spread = hint.std_gap / hint.gap
            grids.append(self._grid_around(
                hint.gap, hint.reach, hint.reach_per_gap, 1.0 + spread, spread / HALF
            ))
        return grids

    def _zoom(self, line: _Line) -> _Grid:
        grid, best = line.grid, line.best
        gap, reach = float(grid.gaps[best]), float(line.reaches[best])
        rise, fall = self._likelihood(line.rise), self._likelihood(line.fall)
        width = grid.width * (_step_change(rise, STEEP) if rise < inf else WIDEN)
        change = WIDEN
        if line.inside:
            change = _step_change(fall, NEAR) if rise < inf else 1.0
        ratio = 1.0 + change * (grid.ratio - 1.0)
        return self._grid_around(gap, reach, _reach_per_gap(line, self._variance), ratio, width)

    def _grid_around(
        self, gap: float, reach: float, reach_per_gap: float, ratio: float, width: float,
    ) -> _Grid:
        """A grid around a gap and a line of reaches through it."""
        ratio, width = min(max(ratio, 1.0 + FINEST), RATIO), min(width, LARGEST_WIDTH)
        steps = np.arange(-HALF, HALF + 1.0)
        gaps = np.asarray(gap * ratio**steps, dtype=np.float64)
        gaps = gaps[gaps <= self._top]
        centre = reach + reach_per_gap * (gaps - gap)
        reaches = centre[:, None] + width * gaps[:, None] * steps
        return _Grid(
            gaps, np.clip(reaches, self._lowest, self._lowest + gaps[:, None]), ratio, width
        )

    def _evaluate(self, grids: Sequence[_Grid]) -> list[_Line]:
        squares, slopes = self._squares(
            np.concatenate([grid.gaps.repeat(grid.reaches.shape[1]) for grid in grids]),
            np.concatenate([grid.reaches.ravel() for grid in grids]),
        )
        lines, end = [], 0
        for grid in grids:
            begin, end, shape = end, end + grid.reaches.size, grid.reaches.shape
            lines.append(_line(
                grid, squares[begin:end].reshape(shape), slopes[begin:end].reshape(shape),
                self._variance,
            ))
        return lines

    def _squares(self, gaps: Array, reaches: Array) -> tuple[Array, Array]:
        """Sums of squared residuals and slopes m of hypotheses (H,); inf unless m > 0."""
        parts = self._unknown_part(self._response(self._play(gaps, reaches))[:, self._heard])
        power, product = (parts * parts).sum(axis=1), parts @ self._y
        with np.errstate(divide='ignore', invalid='ignore'):
            slopes = product / power
        squares = self._y @ self._y - slopes * product
        return np.where((slopes > 0.0) & np.isfinite(squares), squares, inf), slopes

    def _play(self, gaps: Array, reaches: Array) -> Array:
        """The play operators (H,) from these reaches on, shape (H, N)."""
        path = np.empty((len(self._v), len(gaps)))
        reach, upper = reaches.copy(), np.empty(len(gaps))
        for k, v in enumerate(self._v.tolist()):
            np.maximum(reach, v, out=reach)
            np.add(gaps, v, out=upper)
            np.minimum(reach, upper, out=reach)
            path[k] = reach
        return path.T

    def _response(self, u: Array) -> Array:
        """Response (H, N) of G at rest to u (H, N), at the end of the interval in which u acts."""
        b = self._model.numerator[1:]
        return np.asarray(lfilter(b, self._model.denominator, u, axis=1))

    def _unknown_part(self, signals: Array) -> Array:
        """What is left of signals (..., N) without what the state at the start and c_r explain."""
        return np.asarray(signals - (signals @ self._basis) @ self._basis.T)


def _line(grid: _Grid, squares: Array, slopes: Array, variance: float) -> _Line:
    # Where the reach makes no difference the one in the middle is as good as any.
    count = squares.shape[1]
    off_centre = np.abs(np.arange(count) - count // 2)
    best = (squares + INDIFFERENT * variance * off_centre).argmin(axis=1)
    rows = np.arange(len(squares))
    line = squares[rows, best]
    i = int(line.argmin())
    beside = squares[i, max(best[i] - 1, 0):best[i] + 2]
    return _Line(
        grid, grid.reaches[rows, best], line, slopes[rows, best],
        float(beside.max()) - float(line[i]) if len(beside) == 3 else inf,
    )


def _reach_per_gap(line: _Line, variance: float) -> float:
    # Gaps that fit badly may not have found their best reach.
    weights = variance / (variance + (line.squares - line.least))
    gaps = line.grid.gaps - line.grid.gaps[line.best]
    reaches = line.reaches - line.reaches[line.best]
    return float((weights * gaps) @ reaches / max((weights * gaps) @ gaps, TINY))


def _step_change(behind: float, most: float) -> float:
    """Factor for a distance at which the log-likelihood, a parabola, should fall behind less."""
    return min(max(sqrt(0.6 * most / max(behind, TINY)), SHRINK), WIDEN)
