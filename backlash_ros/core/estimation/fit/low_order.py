"""The G of low order that fits a record best, given u.

B and A of the stable part move together in the directions of the prior (error_model.py), by
Gauss-Newton steps on the output error:

    y = (B/A) u,   dy/db_j = z^-j (1/A) u,   dy/da_i = -z^-i (1/A) y

Integrators of G, and its gain at rest, stay as they are. What G did before the record, its free
response, is projected out (G. H. Golub, V. Pereyra, The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate, SIAM J. Numer. Anal. 10 (1973) 413-432).
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.estimation.regression.error_model import MORE_TAPS, ErrorModel
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

SHIFTS = (0, 1, 2, -1)  # samples of delay more than G has that are compared
GAUSS_NEWTON_STEPS = 10  # Gauss-Newton steps, those that were too long included
STANDS = 0.02  # standard deviations by which the coefficients may still move
SHORTER = 0.3  # share of a step that is tried where the whole step leads uphill
# --- guards
NO_TAP = 1e-6  # share of the largest tap below which the last ones are none


def memory_of(model: TransferFunction) -> int:
    """Samples of u that a numerator of low order reaches back."""
    return model.delay + max(SHIFTS) + model.order + MORE_TAPS


class OutputError:
    """The problem: u (N,), applied from k to k+1, and y (N,) after it, with its weights.

    weights: 0 where y was lost or is not to be compared. before: u of the samples before these, as
    many as `memory_of` G: it acts on the first y through the numerator. noise_std: of y. integrate:
    denominator of the integrators of G.
    """

    def __init__(
        self, model: TransferFunction, u: Array, y: Array, weights: Array, before: Array,
        noise_std: float,
    ) -> None:
        self.integrators = int(np.count_nonzero(np.abs(model.poles - 1.0) < ON_CIRCLE))
        self.integrate = np.atleast_1d(np.poly([1.0] * self.integrators))
        compared = np.flatnonzero(weights > 0.0)
        self._rows = len(before) + compared
        self._u, self._y = np.concatenate([before, u]), y[compared]
        self._root = np.sqrt(weights[compared]) / noise_std

    def residual(self, b: Array, a: Array, delay: int) -> tuple[Array, Array]:
        """Weighted residual without the free response, and the response (N,)."""
        answer = lfilter(np.append(np.zeros(delay - 1), b), self._poles(a), self._u)
        rows = (self._y - answer[self._rows]) * self._root
        return self._without_free(rows, self._poles(a)), answer

    def misfit(self, model: TransferFunction) -> float:
        """Twice the negative log-likelihood of another G; its gain at rest is free."""
        poles = np.trim_zeros(model.denominator, 'b')
        answer = lfilter(model.numerator[1:], poles, self._u)[self._rows]
        # Where nothing but free responses is left of y or of u, there is nothing to compare.
        both = np.column_stack([self._y, answer]) * self._root[:, None]
        y, answer = self._without_free(both, poles).T
        power = float(answer @ answer)
        gain = float(answer @ y) / power if power > 0.0 else 0.0
        left = y - gain * answer
        return float(left @ left)

    def slopes(self, a: Array, answer: Array, delay: int, taps: int, prior: Array) -> Array:
        """Derivatives of the weighted response in the directions of the prior, shape (N, ..)."""
        n, count = len(a) - 1, len(self._u)
        by_input = lfilter([1.0], self._poles(a), self._u)
        by_output = lfilter([1.0], a, answer)
        columns = np.zeros((count, taps + n))
        for j in range(taps):
            columns[delay - 1 + j:, j] = by_input[:count - delay + 1 - j]
        for i in range(1, n + 1):
            columns[i:, taps + i - 1] = -by_output[:-i]
        rows = (columns[self._rows] @ prior) * self._root[:, None]
        return self._without_free(rows, self._poles(a))

    def _poles(self, a: Array) -> Array:
        """Denominator of G for that of its stable part."""
        return np.asarray(np.convolve(a, self.integrate), dtype=np.float64)

    def _without_free(self, rows: Array, denominator: Array) -> Array:
        order = len(denominator) - 1
        if order == 0:
            return rows
        free = lfilter([1.0], denominator, np.eye(order, len(self._u)))
        basis = np.linalg.qr(free[:, self._rows].T * self._root[:, None])[0]
        return np.asarray(rows - basis @ (basis.T @ rows))


def low_order(
    model: TransferFunction, error: ErrorModel, problem: OutputError, scale: float,
    shifts: Sequence[int] = SHIFTS,
) -> Generator[None, None, TransferFunction | None]:
    """Fit G, beginning with `model`. None where no stable G comes out.

    scale: of the error of `model`. shifts: samples of delay more than it has that are compared.

    Yields between pieces.
    """
    n = error.taps
    told: Array = np.zeros(n + MORE_TAPS)
    given = model.numerator[model.delay:][:len(told)]
    told[:len(given)] = given
    gain = float(told.sum()) / error.gain
    prior = scale * error.low_order_spread
    cost, delay = np.inf, model.delay
    b: Array = told
    a: Array = error.stable
    for shift in shifts:
        if model.delay + shift >= 1:
            fit = yield from _fit(told, error.stable, model.delay + shift, problem, prior)
            if fit[0] < cost:
                cost, b, a = fit
                delay = model.delay + shift
    if not np.isfinite(cost) or b.sum() * gain <= 0.0:
        return None
    b = b * (gain * float(a.sum()) / float(b.sum()))
    taps = int(np.flatnonzero(np.abs(b) > NO_TAP * np.abs(b).max())[-1]) + 1
    order = max(n, delay + taps - 1 - problem.integrators)  # of the stable part
    numerator: Array = np.zeros(order + problem.integrators + 1)
    denominator: Array = np.append(a, np.zeros(order - n))
    numerator[delay:delay + taps] = b[:taps]
    whole = np.convolve(denominator, problem.integrate)
    return TransferFunction(numerator.tolist(), whole.tolist())


def _fit(
    b: Array, a: Array, delay: int, problem: OutputError, prior: Array,
) -> Generator[None, None, tuple[float, Array, Array]]:
    """Cost, numerator taps and denominator near b and a."""
    taps = len(b)
    start = np.append(b, a[1:])
    best: tuple[float, Array, Array] = (np.inf, b, a)
    xi: Array = np.zeros(prior.shape[1])
    step: Array = xi
    length = 1.0
    for _ in range(GAUSS_NEWTON_STEPS):
        trial = xi + length * step
        value = start + prior @ trial
        b, a = value[:taps], np.append(1.0, value[taps:])
        cost = np.inf
        if np.abs(np.roots(a)).max(initial=0.0) < 1.0 - ON_CIRCLE:
            residual, answer = problem.residual(b, a, delay)
            cost = float(residual @ residual) + float(trial @ trial)
        if not cost < best[0]:
            length *= SHORTER
            continue
        xi, length, best = trial, 1.0, (cost, b, a)
        slopes = np.concatenate([problem.slopes(a, answer, delay, taps, prior), np.eye(len(xi))])
        step = np.linalg.lstsq(slopes, np.append(residual, -xi), rcond=None)[0]
        if np.linalg.norm(slopes @ step) <= STANDS:
            break
        yield
    return best
