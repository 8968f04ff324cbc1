"""The G of low order that may be, given how uncertain the one is that was told.

B and A of the stable part move together in the directions of the prior (error_model.py).
Integrators of G, and its gain at rest, stay as they are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit.low_order.output_error import OutputError
from backlash_ros.core.estimation.regression.error_model import MORE_TAPS, ErrorModel
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

SHIFTS = (0, 1, 2, -1)  # samples of delay more than G has that are compared
# --- guards
NO_TAP = 1e-6  # share of the largest tap below which the last ones are none


def memory_of(model: TransferFunction) -> int:
    """Samples of u that a numerator of low order reaches back."""
    return model.delay + max(SHIFTS) + model.order + MORE_TAPS


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
