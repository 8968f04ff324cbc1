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

from backlash_ros.core.estimation.constants import STANDS
from backlash_ros.core.estimation.regression.error_model import MORE_TAPS, ErrorModel
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

SHIFTS = (0, 1, 2, -1)  # samples of delay more than G has that are compared
GAUSS_NEWTON_STEPS = 10  # Gauss-Newton steps, those that were too long included
SHORTER = 0.3  # share of a step that is tried where the whole step leads uphill
# --- guards
NO_TAP = 1e-6  # share of the largest tap below which the last ones are none


def memory_of(model: TransferFunction) -> int:
    """Samples of u that a numerator of low order reaches back."""
    return model.delay + max(SHIFTS) + model.order + MORE_TAPS


class OutputError:
    """The problem: u (N,), applied from k to k+1, and y (N,) after it, with its weights.

    weights: 0 where y was lost or is not to be compared. before: u of the samples before these, as
    many as `memory_of` G: it acts on the first y through the numerator. noise_std: of y.
    samples: N. integrate: denominator of the integrators of G.
    """

    def __init__(
        self, model: TransferFunction, u: Array, y: Array, weights: Array, before: Array,
        noise_std: float,
    ) -> None:
        self.integrators = int(np.count_nonzero(np.abs(model.poles - 1.0) < ON_CIRCLE))
        self.integrate = np.atleast_1d(np.poly([1.0] * self.integrators))
        self._root = np.sqrt(weights) / noise_std
        self._y = np.where(weights > 0.0, y, 0.0) * self._root
        self._u, self._first = np.concatenate([before, u]), len(before)
        self.samples = len(y)

    def poles(self, a: Array) -> Array:
        """Denominator of G for that of its stable part."""
        return np.asarray(np.convolve(a, self.integrate), dtype=np.float64)

    def free_responses(self, poles: Array) -> Array:
        """Orthonormal basis of the weighted free responses of G, shape (N, ..)."""
        return np.asarray(np.linalg.qr((self.free(poles) * self._root).T)[0])

    def free(self, poles: Array) -> Array:
        """Free responses of G, shape (n, N)."""
        order = len(poles) - 1
        return np.asarray(lfilter([1.0], poles, np.eye(max(order, 1), self.samples))[:order])

    def response(self, b: Array, poles: Array, delay: int) -> Array:
        """Response of G to u and what was before it, from the first of these on."""
        return np.asarray(lfilter(np.append(np.zeros(delay - 1), b), poles, self._u))

    def newest(self, answer: Array) -> Array:
        """The part of a response that y is compared with, shape (N,)."""
        return answer[self._first:]

    def residual(self, answer: Array, free: Array) -> Array:
        """Weighted residual of a response without the free responses, shape (N,)."""
        return _without(free, self._y - self.newest(answer) * self._root)

    def misfit(self, model: TransferFunction) -> float:
        """Twice the negative log-likelihood of another G; its gain at rest is free."""
        poles = np.trim_zeros(model.denominator, 'b')
        answer = self.newest(self.response(model.numerator[1:], poles, 1)) * self._root
        # Where nothing but free responses is left of y or of u, there is nothing to compare.
        y, answer = _without(self.free_responses(poles), np.stack([self._y, answer]))
        power = float(answer @ answer)
        gain = float(answer @ y) / power if power > 0.0 else 0.0
        left = y - gain * answer
        return float(left @ left)

    def slopes(self, a: Array, answer: Array, delay: int, taps: int, free: Array) -> Array:
        """Derivatives of the weighted response by the taps and by a, shape (.., N)."""
        return _without(free, self.unweighted_slopes(a, answer, delay, taps) * self._root)

    def unweighted_slopes(self, a: Array, answer: Array, delay: int, taps: int) -> Array:
        """The same without weights, and with the free responses, shape (.., N)."""
        n, count = len(a) - 1, len(self._u)
        by_input = lfilter([1.0], self.poles(a), self._u)
        by_output = lfilter([1.0], a, answer)
        slopes = np.zeros((taps + n, count))
        for j in range(taps):
            slopes[j, delay - 1 + j:] = by_input[:count - delay + 1 - j]
        for i in range(1, n + 1):
            slopes[taps + i - 1, i:] = -by_output[:-i]
        return slopes[:, self._first:]


def _without(basis: Array, signals: Array) -> Array:
    """What is left of signals (.., N) beside an orthonormal basis (N, ..)."""
    return np.asarray(signals - (signals @ basis) @ basis.T)


class Family:
    """The G of low order around `model`, with the scale of its error. xi (k,): which one it is.

    Of all of them xi is standard normal. taps: of the numerator. prior: from xi to the taps and
    the stable part of the denominator, shape (taps + n, k).
    """

    def __init__(self, model: TransferFunction, error: ErrorModel, scale: float) -> None:
        self.model, self._error = model, error
        self.taps = error.taps + MORE_TAPS
        told: Array = np.zeros(self.taps)
        given = model.numerator[model.delay:][:self.taps]
        told[:len(given)] = given
        self._gain = float(told.sum()) / error.gain
        self._told = np.append(told, error.stable[1:])
        self.prior = scale * error.low_order_spread

    @property
    def told(self) -> Array:
        """The xi of `model`."""
        return np.zeros(self.prior.shape[1])

    def coefficients(self, xi: Array) -> tuple[Array, Array] | None:
        """Taps and denominator of the stable part; None where that is not stable."""
        value = self._told + self.prior @ xi
        b, a = value[:self.taps], np.append(1.0, value[self.taps:])
        stable = np.abs(np.roots(a)).max(initial=0.0) < 1.0 - ON_CIRCLE
        return (b, a) if stable else None

    def transfer_function(
        self, xi: Array, delay: int, problem: OutputError,
    ) -> TransferFunction | None:
        """G with the gain at rest of `model`; None where it has none of this sign."""
        coefficients = self.coefficients(xi)
        if coefficients is None:
            return None
        b, a = coefficients
        if b.sum() * self._gain <= 0.0:
            return None
        b = b * (self._gain * float(a.sum()) / float(b.sum()))
        n = len(a) - 1
        taps = int(np.flatnonzero(np.abs(b) > NO_TAP * np.abs(b).max())[-1]) + 1
        order = max(n, delay + taps - 1 - problem.integrators)  # of the stable part
        numerator: Array = np.zeros(order + problem.integrators + 1)
        denominator: Array = np.append(a, np.zeros(order - n))
        numerator[delay:delay + taps] = b[:taps]
        whole = np.convolve(denominator, problem.integrate)
        return TransferFunction(numerator.tolist(), whole.tolist())


def low_order(
    family: Family, problem: OutputError, shifts: Sequence[int] = SHIFTS,
) -> Generator[None, None, tuple[Array, int]]:
    """Fit G, beginning with the told one; its xi, and its delay in samples.

    shifts: samples of delay more than the told one has that are compared. Yields between pieces.
    """
    cost, delay = np.inf, family.model.delay
    best = family.told
    for shift in shifts:
        if family.model.delay + shift >= 1:
            fit = yield from _fit(family, family.model.delay + shift, problem)
            if fit[0] < cost:
                cost, best = fit
                delay = family.model.delay + shift
    return best, delay


def _fit(
    family: Family, delay: int, problem: OutputError,
) -> Generator[None, None, tuple[float, Array]]:
    """Cost and xi."""
    xi = step = family.told
    best = (np.inf, xi)
    length = 1.0
    for _ in range(GAUSS_NEWTON_STEPS):
        trial = xi + length * step
        cost = np.inf
        coefficients = family.coefficients(trial)
        if coefficients is not None:
            b, a = coefficients
            poles = problem.poles(a)
            free, answer = problem.free_responses(poles), problem.response(b, poles, delay)
            residual = problem.residual(answer, free)
            cost = float(residual @ residual) + float(trial @ trial)
        if not cost < best[0]:
            length *= SHORTER
            continue
        xi, length, best = trial, 1.0, (cost, trial)
        slopes = problem.slopes(a, answer, delay, family.taps, free)
        rows = np.concatenate([slopes.T @ family.prior, np.eye(len(xi))])
        step = np.linalg.lstsq(rows, np.append(residual, -xi), rcond=None)[0]
        if np.linalg.norm(rows @ step) <= STANDS:
            break
        yield
    return best
