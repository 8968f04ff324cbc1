"""Fit of the backlash, its delay and its sign to a whole record of v and y at once.

Given the width g of the gap and the delay d, the play operator makes u known up to two numbers,
u = m r - m c_r with the reach r = clamp(r, v, v + g), and y is linear in them and in the state at
the start:

    y = G[r(k-d)] m - G[1] m c_r + (free response of G)

so that each (g, d) is one linear least-squares problem, without any assumption on the sign of m.
For checking a record once; while the loop runs, the Kalman filters learn.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

GAPS = 24  # of the grid, up to the widest one
WIDEST = 0.95  # share of the swing of v that the widest gap takes ...
WARM_UP = 0.6  # ... if v has swung that far within this share of the record
NARROWEST = 1e-3  # share of the swing of v
MORE_DELAY = 8  # samples that are tried beyond the expected delay
FEWEST_ROWS = 10  # per unknown
# Share of the motion of y that is not worth telling delays apart by.
FLOOR = 1e-4
WILD = 6.0  # standard deviations
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution with a median of |x| of 1


@dataclass(frozen=True)
class RecordFit:
    """What fits a record best.

    m is negative where G has the wrong sign. std_m: its standard deviation. delay [samples];
    margins: log-likelihood by which each delay 0, 1, ... falls behind it. predicted: share of
    the motion of y, beyond what a constant u explains, that the fit predicts (1: all of it).
    evidence: log-likelihood by which it beats a constant u. noise_std: robust deviation of the
    residual, rms: its plain one [unit of y]. correlation: of successive residuals.
    """

    m: float
    c_r: float
    c_l: float
    std_m: float
    delay: int
    margins: tuple[float, ...]
    predicted: float
    evidence: float
    noise_std: float
    rms: float
    correlation: float


def fit_record(
    model: TransferFunction, v: Array, y: Array, expected_delay: int = 0,
) -> RecordFit | None:
    """Fit v (N,), applied from k to k+1, and y (N,), nan where lost; G without any delay of v.

    None where v stands still or the record is too short.
    """
    longest = expected_delay + MORE_DELAY
    swing = float(np.ptp(v)) if len(v) else 0.0
    if swing == 0.0:
        return None
    swung = float(np.ptp(v[: int(WARM_UP * len(v)) + 1]))
    widest = max(min(WIDEST, swung / swing), 2.0 * NARROWEST)
    grid = swing * np.append(0.0, np.geomspace(NARROWEST, widest, GAPS))
    # All are compared over the same samples: those after the slowest start.
    begin = _first_swing(v, float(grid[-1])) + longest + 1
    rows = np.flatnonzero(np.isfinite(y[begin:])) + begin
    unknowns = model.order + 2
    if len(rows) < FEWEST_ROWS * unknowns:
        return None
    problem = _Problem(model, v, y, rows)
    best = [problem.best_gap(grid, delay) for delay in range(longest + 1)]
    floor = len(rows) * (FLOOR * float(np.ptp(y[rows]))) ** 2 + np.finfo(float).tiny
    squares = [problem.squares(gap, delay) + floor for delay, gap in enumerate(best)]
    delay = int(np.argmin(squares))
    half = 0.5 * len(rows)
    margins = tuple(half * log(value / squares[delay]) for value in squares)
    return problem.describe(best[delay], delay, margins, floor)


class _Problem:
    """Least squares over fixed samples for any gap and delay."""

    def __init__(self, model: TransferFunction, v: Array, y: Array, rows: NDArray[np.intp]) -> None:
        self._model, self._v, self._y, self._rows = model, v, y, rows
        count = len(v) + 1
        # Whatever came before the first row is a state there: what n impulses can leave behind.
        impulse = np.zeros((model.order, count))
        impulse[np.arange(model.order), rows[0] + np.arange(model.order)] = 1.0
        free = [lfilter([1.0], model.denominator, row) for row in impulse]
        constant = self._response(np.ones(len(v)))
        self._known = np.stack([*free, constant], axis=1)

    def best_gap(self, grid: Array, delay: int) -> float:
        """Gap that fits best for a delay: the best of a grid, then refined between neighbours."""
        squares = [self.squares(float(gap), delay) for gap in grid]
        best = int(np.argmin(squares))
        low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
        found = minimize_scalar(
            lambda gap: self.squares(float(gap), delay), bounds=(low, high), method='bounded',
            options={'xatol': 1e-7 * float(grid[-1])},
        )
        return float(found.x) if found.fun < squares[best] else float(grid[best])

    def squares(self, gap: float, delay: int) -> float:
        """Sum of the squared residuals."""
        residual = self._solve(gap, delay)[1]
        return float(residual @ residual)

    def describe(
        self, gap: float, delay: int, margins: tuple[float, ...], floor: float,
    ) -> RecordFit:
        """All there is to say about one gap and delay."""
        solution, residual, variance_of_m = self._solve(gap, delay, trimmed=True)
        null = _least_squares(self._known[self._rows], self._y[self._rows])[1]
        squares, null_squares = float(residual @ residual), float(null @ null)
        m, product = float(solution[-1]), float(solution[-2])
        rms = (squares / len(residual)) ** 0.5
        c_r = -product / m if m else float('nan')
        return RecordFit(
            m=m, c_r=c_r, c_l=c_r - gap, std_m=rms * variance_of_m**0.5, delay=delay,
            margins=margins, predicted=1.0 - (squares / max(null_squares, floor)) ** 0.5,
            evidence=0.5 * len(residual) * log((null_squares + floor) / (squares + floor)),
            noise_std=NORMAL_MAD * float(np.median(np.abs(residual))), rms=rms,
            correlation=float(residual[1:] @ residual[:-1]) / max(squares, floor * 1e-12),
        )

    def _solve(
        self, gap: float, delay: int, trimmed: bool = False,
    ) -> tuple[Array, Array, float]:
        """Solution (..., m c_r negated, m), residual, and the variance of m at unit noise.

        trimmed: solve again without the wildest samples, so that a v that came late now and then
        does not disturb the rest.
        """
        moved = self._response(reach_of(self._v, gap))
        rows = self._rows
        columns, y = np.column_stack([self._known[rows], moved[rows - delay]]), self._y[rows]
        solution, residual, variance = _least_squares(columns, y)
        if trimmed:
            distance = np.abs(residual)
            kept = distance <= WILD * NORMAL_MAD * float(np.median(distance))
            solution, _, variance = _least_squares(columns[kept], y[kept])
            residual = y - columns @ solution
        return solution, residual, variance

    def _response(self, u: Array) -> Array:
        """Response of G at rest to u, shape (N + 1,)."""
        model = self._model
        response = lfilter(model.numerator, model.denominator, np.append(u, u[-1]))
        return np.asarray(response, dtype=np.float64)


def _least_squares(columns: Array, y: Array) -> tuple[Array, Array, float]:
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    scaled = columns / scale
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    kept = s > s[0] * 1e-12
    inverse = np.where(kept, 1.0 / np.where(kept, s, 1.0), 0.0)
    solution = vt.T @ (inverse * (u.T @ y))
    last = inverse * vt[:, -1]
    return solution / scale, y - scaled @ solution, float(last @ last) / float(scale[-1]) ** 2


def reach_of(v: Array, gap: float) -> Array:
    """Play operator r = clamp(r, v, v + gap), shape (N,), from the first engagement on.

    Until v has swung over the gap, r is where the first engagement finds it.
    """
    first = _first_swing(v, gap)
    rising = v[first] >= v[: first + 1].max()
    reach = float(v[first]) if rising else float(v[first]) + gap
    reaches = np.full(len(v), reach)
    for k, value in enumerate(v[first:].tolist(), first):
        reach = min(max(reach, value), value + gap)
        reaches[k] = reach
    return reaches


def _first_swing(v: Array, gap: float) -> int:
    """First sample at which v has swung over the gap."""
    swing = np.maximum.accumulate(v) - np.minimum.accumulate(v)
    return int(np.argmax(swing >= gap))
