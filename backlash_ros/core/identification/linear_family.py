"""A nonlinearity of v, and all that is linear between it and y, solved for exactly.

Taps, lags of several lengths, an integral, an offset, a drift and a characteristic that is not
straight: what is compared depends on no G that was fitted with a play.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import copysign
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]


def centred(v: Array, width: float) -> Array:
    """Play about its middle."""
    width = abs(width)
    return play(v, width, float(v[0]) + 0.5 * width) - 0.5 * width


def coasting(v: Array, width: float, dry: float, viscous: float) -> Array:
    """Play with a load that runs on from the side that it leaves, braked by dry friction and by a
    share of its speed each sample."""
    half, dry, kept = 0.5 * abs(width), abs(dry), 1.0 - min(abs(viscous), 1.0)
    place, speed, out = float(v[0]), 0.0, []
    for value in v.tolist():
        speed = copysign(max(kept * abs(speed) - dry, 0.0), speed)
        on = min(max(place + speed, value - half), value + half)
        if on != place + speed:
            speed = on - place
        place = on
        out.append(place)
    return np.array(out)


class Candidate(NamedTuple):
    """Squares that a nonlinearity leaves, its parameters, and what it has y follow."""

    squares: float
    at: tuple[float, ...]
    columns: Array


class LinearFamily:
    """Everything linear between the output of a nonlinearity (N,) and y (N,), nan where lost.

    v: scaled to 0 to 1, as are the parameters of nonlinearities.
    """

    def __init__(self, v: Array, y: Array) -> None:
        self.low, self.swing = float(v.min()), max(float(np.ptp(v)), 1e-300)
        self.v = (v - self.low) / self.swing
        known = np.flatnonzero(np.isfinite(y) & (np.arange(len(y)) >= min(len(y) // 10, 100)))
        self.rows = known[::max(len(known) // 1500, 1)]
        self.target = y[self.rows]
        bend = self.v - self.v.mean()
        self.common = np.column_stack([
            np.ones(len(v)), np.linspace(-1.0, 1.0, len(v)), bend**2, bend**3])[self.rows]

    def columns(self, w: Array) -> Array:
        """Three taps, lags and, last, the integral of w (N,)."""
        w = w - w.mean()
        steps = np.diff(w, prepend=[w[0], w[0]])
        found = [w, steps[1:], np.diff(steps)]
        for lag in (0.7, 2.0, 6.0, 20.0, 60.0):  # [samples]
            a = float(np.exp(-1.0 / lag))
            found.append(lfilter([1.0 - a], [1.0, -a], w, state=[w[0] * a]))
        return np.column_stack([*found, np.cumsum(w)])[self.rows]

    def solved(self, columns: Array, part: slice = slice(None)) -> tuple[float, Array]:
        """Squares left over of a part of the rows, and the solution for columns and `common`."""
        whole, target = np.column_stack([columns, self.common])[part], self.target[part]
        scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
        scale[scale == 0.0] = 1.0
        whole /= scale
        solution = np.linalg.lstsq(whole.T @ whole, whole.T @ target, rcond=1e-13)[0]
        left = target - whole @ solution
        return float(left @ left), solution / scale

    def best(
        self, nonlinearity: Callable[..., Array], starts: Sequence[tuple[float, ...]],
        evaluations: int = 50,
    ) -> Candidate:
        """The best parameters of a nonlinearity of v, from the best two starts."""
        from scipy.optimize import minimize  # a fifth of the time that a start takes

        def left(at: Sequence[float]) -> float:
            w = nonlinearity(self.v, *at)
            return self.solved(self.columns(w))[0] if np.ptp(w) > 0.0 else 1e300

        found = sorted((left(at), at) for at in starts)[:2]
        for _, at in list(found):
            result = minimize(left, at, method='Nelder-Mead',
                              options={'maxfev': evaluations, 'xatol': 1e-4})
            found.append((float(result.fun), tuple(result.x.tolist())))
        squares, at = min(found)
        return Candidate(squares, at, self.columns(nonlinearity(self.v, *at)))

    def changing(self, gap: float, basis: Array) -> tuple[Array, Candidate]:
        """Gaps [v] of a basis (B, N) that make up the width of a play, from a constant gap.

        Gauss-Newton steps: the linear system, and the widths with it.
        """
        widths: Array = np.full(len(basis), max(gap / self.swing, 1e-4))
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
        return self.swing * np.maximum(best[0], 0.0), best[1]

    def share(self, other: Candidate, one: Candidate, noise: float) -> float:
        """Of what `one` leaves beyond the noise, what `other` explains; 0 where that is chance."""
        beyond = max(one.squares - noise**2 * len(self.rows), 1e-300)
        # Neighbours of smooth residuals tell little of their own.
        gain = 0.2 * len(self.rows) * np.log(one.squares / max(other.squares, 1e-300))
        return (one.squares - other.squares) / beyond if gain >= 15.0 else 0.0

    def beats(self, other: Candidate, one: Candidate, noise: float) -> bool:
        """Whether `other` explains next to all, and much in both halves of the record."""
        explained, half = 0.95, len(self.rows) // 2
        return self.share(other, one, noise) >= explained and all(
            self.solved(other.columns, part)[0]
            < (1.0 - 0.5 * explained) * self.solved(one.columns, part)[0]
            for part in (slice(0, half), slice(half, None))
        )


@dataclass(frozen=True)
class Observed:
    """A record and its fit, N samples each. y: nan where lost. p: play output [v], as it acts on y
    (the delay is in it). simulated: y without noise. noise: standard deviation of white noise and
    rounding of y. gap: that of p."""

    v: Array
    y: Array
    p: Array
    simulated: Array
    noise: float
    gap: float

    @property
    def residual(self) -> Array:
        """y less what was simulated."""
        return np.asarray(self.y - self.simulated)

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(np.nanmean(self.residual**2)))

    @property
    def swing(self) -> float:
        """Of y."""
        return float(np.nanmax(self.y) - np.nanmin(self.y))

    @property
    def unexplained(self) -> bool:
        """Whether the residual is more than noise."""
        return self.rms > max(1.5 * self.noise, 1e-3 * self.swing)

    @cached_property
    def family(self) -> LinearFamily | None:
        """To compare nonlinearities by; None where there is too little."""
        part = slice(0, min(len(self.v), 4000))
        family = LinearFamily(self.v[part], self.y[part])
        return family if np.ptp(family.v) > 0.0 and len(family.rows) >= 100 else None

    @cached_property
    def one_play(self) -> Candidate:
        """The best play."""
        assert self.family is not None
        widths = (6e-4, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, self.gap / self.family.swing)
        return self.family.best(centred, [(width,) for width in widths])

    @cached_property
    def coasting(self) -> Candidate:
        """The best play with a load that coasts within it."""
        assert self.family is not None
        best = self.one_play.at[0]
        return self.family.best(coasting, [
            (width, *brakes) for width in (best, 1.3 * best, 1.3 * self.gap / self.family.swing)
            for brakes in ((0.0, 0.0), (3e-4, 0.0), (3e-3, 0.0), (0.0, 0.03), (0.0, 0.2))], 100)
