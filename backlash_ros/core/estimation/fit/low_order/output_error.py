"""The output error of a G of low order for given u, and its derivatives.

    y = (B/A) u,   dy/db_j = z^-j (1/A) u,   dy/da_i = -z^-i (1/A) y

What G did before the record, its free response, is projected out (G. H. Golub, V. Pereyra, The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate,
SIAM J. Numer. Anal. 10 (1973) 413-432).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]


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
        responses = np.zeros((len(poles) - 1, self.samples))
        impulse = np.zeros(self.samples)
        impulse[0] = 1.0
        response = lfilter([1.0], poles, impulse)
        for delay, delayed in enumerate(responses):
            delayed[delay:] = response[:self.samples - delay]
        return responses

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
