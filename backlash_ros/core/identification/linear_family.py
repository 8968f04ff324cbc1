"""Nonlinearities in place of a play, compared through one and the same general linear family.

Behind each of them are a few taps, lags of several lengths, an integral, an offset, a drift and a
characteristic that is not straight. These are solved for exactly, so that no comparison depends on
the G that was fitted with a play.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.play import play
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]

TAPS, LAG_LENGTHS = 3, (0.7, 2.0, 6.0, 20.0, 60.0)  # [samples]


class Candidate(NamedTuple):
    """Squares that a nonlinearity leaves, its parameters, and what it has y follow."""

    squares: float
    at: tuple[float, ...]
    columns: Array


class LinearFamily:
    """Everything linear between the output of a nonlinearity (N,) and y (N,), nan where lost."""

    def __init__(self, v: Array, y: Array) -> None:
        self.v = v
        known = np.flatnonzero(np.isfinite(y) & (np.arange(len(y)) >= min(len(y) // 10, 100)))
        self.rows = known[::max(len(known) // 1500, 1)]
        self.target = y[self.rows]
        bend = (v - v.mean()) / max(float(np.ptp(v)), 1e-300)
        self.common = np.column_stack([
            np.ones(len(v)), np.linspace(-1.0, 1.0, len(v)), bend**2, bend**3])[self.rows]

    @property
    def unknowns(self) -> int:
        """Columns that are solved for."""
        return TAPS + len(LAG_LENGTHS) + 1 + self.common.shape[1]

    def play(self, width: float) -> Array:
        """Play (N,) about its middle."""
        width = abs(width)
        return play(self.v, width, float(self.v[0]) + 0.5 * width) - 0.5 * width

    def columns(self, w: Array) -> Array:
        """Taps, lags and, last, the integral of w (N,)."""
        w = w - w.mean()
        found = [np.append(np.full(k, w[0]), w[:len(w) - k]) for k in range(TAPS)]
        for lag in LAG_LENGTHS:
            a = float(np.exp(-1.0 / lag))
            found.append(lfilter([1.0 - a], [1.0, -a], w, state=[w[0] * a]))
        return np.column_stack([*found, np.cumsum(w)])[self.rows]

    def solved(self, columns: Array, part: slice = slice(None)) -> tuple[float, Array]:
        """Squares left over of a part of the rows, and the solution for columns and `common`."""
        whole = np.column_stack([columns, self.common])[part]
        scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
        scale[scale == 0.0] = 1.0
        solution = np.linalg.lstsq(whole / scale, self.target[part], rcond=1e-9)[0] / scale
        left = self.target[part] - whole @ solution
        return float(left @ left), solution

    def best(
        self, nonlinearity: Callable[..., Array], starts: Sequence[tuple[float, ...]],
    ) -> Candidate:
        """The best parameters of a nonlinearity, from the best two starts."""
        from scipy.optimize import minimize  # a fifth of the time that a start takes
        scale = max(float(np.ptp(self.v)), 1e-300)

        def left(at: Sequence[float]) -> float:
            w = nonlinearity(*at)
            return self.solved(self.columns(w))[0] if np.ptp(w) > 0.0 else np.inf

        found = sorted((left(at), tuple(at)) for at in starts)[:2]
        for _, at in list(found):
            result = minimize(
                lambda x: left(tuple(x * scale)), np.array(at) / scale, method='Nelder-Mead',
                options={'maxfev': 50, 'xatol': 1e-4},
            )
            found.append((float(result.fun), tuple((result.x * scale).tolist())))
        squares, at = min(found)
        return Candidate(squares, at, self.columns(nonlinearity(*at)))

    def parallel(self, plays: Sequence[Array]) -> tuple[Array, Candidate]:
        """Weights, none of them negative, of several plays in parallel, and what is left over."""
        from scipy.optimize import nnls
        columns = [self.columns(w) for w in plays]
        best, weights = Candidate(np.inf, (), columns[0]), np.zeros(len(plays))
        # In turn: the weights for a linear system behind them, and that system for the weights.
        # Offset, drift and bend may have any sign.
        free = np.column_stack([self.common, -self.common])
        sign = np.sign(np.corrcoef(self.v[self.rows], self.target)[0, 1])
        for begin in (0, TAPS + 1, TAPS + 2, TAPS + 3):
            linear = sign * np.eye(columns[0].shape[1])[begin]
            for _ in range(3):
                each = np.column_stack([one @ linear for one in columns])
                found = nnls(np.column_stack([each, free]), self.target)[0][:len(plays)]
                if not found.any():
                    break
                summed = np.tensordot(found / found.sum(), columns, axes=1)
                squares, solution = self.solved(summed)
                linear = solution[:summed.shape[1]]
                if squares < best.squares:
                    best, weights = Candidate(squares, (), summed), found / found.sum()
        return weights, best

    def changing(self, gap: float, basis: Array) -> tuple[Array, Candidate]:
        """Coefficients of a basis (B, N) that make up the width of a play, from a constant one.

        Gauss-Newton steps: the linear system, and the widths with it.
        """
        widths: Array = np.full(len(basis), max(gap, 1e-4 * float(np.ptp(self.v))))
        best = widths, Candidate(np.inf, (), np.empty(0))
        for _ in range(8):
            half, place = 0.5 * np.maximum(widths @ basis, 0.0), float(self.v[0])
            held = []
            for low, high in zip((self.v - half).tolist(), (self.v + half).tolist(), strict=True):
                place = min(max(place, low), high)
                held.append(place)
            p = np.array(held)
            columns = self.columns(p)
            squares, solution = self.solved(columns)
            if not squares < best[1].squares:
                break
            best = widths, Candidate(squares, (), columns)
            side = np.where(p == self.v - half, -0.5, np.where(p == self.v + half, 0.5, 0.0))
            last = np.maximum.accumulate(np.where(side != 0.0, np.arange(len(side)), 0))
            moved = [self.columns((side * one)[last]) @ solution[:columns.shape[1]]
                     for one in basis]
            widths = widths + self.solved(np.column_stack([*moved, columns]))[1][:len(basis)]
        return best

    def explains(self, other: Candidate, one: Candidate, noise: float, share: float) -> bool:
        """Whether `other` explains this share of what `one` leaves over beyond the noise."""
        beyond = max(one.squares - noise**2 * len(self.rows), 1e-300)
        # Neighbours of smooth residuals tell little of their own.
        gain = 0.2 * len(self.rows) * np.log(one.squares / max(other.squares, 1e-300))
        return bool(gain >= 15.0 and one.squares - other.squares >= share * beyond)

    def beats(self, other: Candidate, one: Candidate, noise: float, share: float) -> bool:
        """The same in both halves: what happens to fit one part does not fit the other."""
        half = len(self.rows) // 2
        return self.explains(other, one, noise, share) and all(
            self.solved(other.columns, part)[0]
            < (1.0 - 0.5 * share) * self.solved(one.columns, part)[0]
            for part in (slice(0, half), slice(half, None))
        )
