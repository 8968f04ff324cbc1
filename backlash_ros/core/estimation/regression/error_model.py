"""How wrong G may be: its poles, its delay, and the first taps of its numerator.

With A the polynomial of the moving poles of G, neither integrators nor delays, n of them,

    G_true = G A(1)/A'(1) A/A' (1 + (1 - z^-1) (h_0 + h_1 z^-1)) = G (1 + Delta)

where the poles of A' are off in natural frequency, damping ratio or time constant
(pole_places.py). Nothing has a gain at rest, so that the DC gain (the velocity gain of an
integrating G) stays in m. To first order in xi, the unknowns in units of their deviations,

    Delta = (1 - z^-1) sum_i h_i F_i(z),   h = L xi,   F = 1, z^-1;  z^-j A(1) / A, j = 0 .. n-1

The fit moves the poles and the delay of G until first order is all there is (relabelling.py). The
prior stays that of the G that was told; its scale is learned (posterior.py).
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.estimation.constants import FREE_TAPS, LEAK
from backlash_ros.core.estimation.regression.pole_places import PolePlaces
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

FURTHEST = log(2.0)  # logarithm of a time constant that is moved by at once, at most
ALMOST_ONE = 0.75  # samples of lag from which on it is one of the delay
TAPS = 2  # of the numerator: with them delays by parts of a sample, and the first beyond


class ErrorModel:
    """Filters F_i of a model G, and the prior of their coefficients.

    model: G, which may have been moved from the one that was told. uncertainty: as told. stable:
    A, monic. gain: A(1). taps: n. count: number K of unknowns, 0 where G is exact. leak: prior
    deviation of that of an integrator, per sample. spread: L, shape (n + 2, K). told: xi of the G
    that was told, which the prior is around, shape (K,).
    """

    def __init__(self, model: StateModel, uncertainty: float) -> None:
        self.uncertainty = uncertainty
        self.model, self._told_model = model, model.transfer_function
        poles = self._told_model.poles
        moving = poles[(np.abs(poles) > ON_CIRCLE) & (np.abs(poles) < 1.0 - ON_CIRCLE)]
        self._places = PolePlaces(moving, uncertainty)
        integrators = int(np.count_nonzero(np.abs(poles - 1.0) < ON_CIRCLE))
        self._integrate = np.atleast_1d(np.poly([1.0] * integrators))
        self.taps = len(moving)
        self.integrates = integrators > 0
        self.leak = LEAK * uncertainty if self.integrates else 0.0
        self.count = TAPS + len(self._places.told) if uncertainty > 0.0 else 0
        self.told: Array = np.zeros(self.count)
        self.stable: Array = np.atleast_1d(np.real(np.poly(moving)))
        self.gain = self._told_gain = float(self.stable.sum())
        # The first tap is a lag; only that slow motion tells of it, so the second one is little.
        lag = uncertainty * _delay(self._told_model, self.stable)
        self._of_taps = lag * np.array([1.0, FREE_TAPS])
        self.spread = self._spread()

    def _spread(self) -> Array:
        """L: the taps by a lag, and what the places of poles change of A."""
        spread = np.zeros((TAPS + self.taps, self.count))
        if self.count:
            spread[:TAPS, :TAPS] = np.diag(self._of_taps)
            for column, slope in enumerate(self._places.slopes(-self.told[TAPS:]), TAPS):
                # d ln(A(1)/A) has a zero at z = 1, which is divided out.
                numerator = self.stable * (float(slope.sum()) / self.gain) - slope
                spread[TAPS:, column] = np.cumsum(numerator)[:-1] / self.gain
        return spread

    def moved(self, xi: Array) -> ErrorModel:
        """The same prior around the G with the poles at xi (K,).

        But no further than first order holds, and where poles would leave the unit circle all go
        half as far.
        """
        told = self.told[TAPS:]
        step = xi[TAPS:] * min(FURTHEST / max(self._places.distance(xi[TAPS:]), FURTHEST), 1.0)
        denominator = self._places.denominator(step - told)
        while denominator is None:
            step = 0.5 * step
            denominator = self._places.denominator(step - told)
        apart = np.append(np.zeros(TAPS), step)
        return self._around(denominator, self.model.transfer_function.delay, apart)

    def delayed(self, xi: Array) -> ErrorModel:
        """The same with whole samples of delay more or less, where the taps at xi (K,) want it."""
        lag = -float(self._of_taps @ xi[:TAPS])
        late = 0 if abs(lag) < ALMOST_ONE else max(min(round(lag), TAPS), -TAPS)
        return self.later(max(late, 1 - self.model.transfer_function.delay))

    def later(self, samples: int) -> ErrorModel:
        """The same around the G with so many samples more of delay, TAPS at most."""
        if samples == 0:
            return self
        apart = np.zeros(self.count)
        apart[0] = -samples / self._of_taps[0]
        return self._around(self.stable, self.model.transfer_function.delay + samples, apart)

    def _around(self, denominator: Array, delay: int, apart: Array) -> ErrorModel:
        """Around another G, whose xi is `apart` (K,)."""
        other = copy(self)
        other.stable, other.gain = denominator, float(denominator.sum())
        other.told = self.told - apart
        other.model = StateModel(self._transfer_function(denominator, delay, np.ones(1)))
        other.spread = other._spread()
        return other

    def low_order(self, xi: Array) -> TransferFunction | None:
        """The G at xi (K,), of which the taps are a part; None where it is not stable."""
        denominator = self._places.denominator(xi[TAPS:] - self.told[TAPS:])
        if denominator is None:
            return None
        first, second = (self._of_taps * xi[:TAPS]).tolist()
        taps = np.array([1.0 + first, second - first, -second])
        return self._transfer_function(denominator, self.model.transfer_function.delay, taps)

    def _transfer_function(self, stable: Array, delay: int, taps: Array) -> TransferFunction:
        """G with these poles and this delay, its numerator times these taps."""
        told = np.trim_zeros(self._told_model.numerator, 'fb')
        b = np.convolve(told, taps) * (float(stable.sum()) / self._told_gain)
        a = np.convolve(stable, self._integrate)
        order = max(len(a) - 1, delay + len(b) - 1)
        numerator, denominator = np.zeros(order + 1), np.zeros(order + 1)
        numerator[delay:delay + len(b)], denominator[:len(a)] = b, a
        return TransferFunction(numerator.tolist(), denominator.tolist())

    def filtered(self, direct: Array) -> Array:
        """Responses of the F_i to signals (..., N) that were 0 before, shape (..., N, n + 2)."""
        once = lfilter([self.gain], self.stable, direct)
        count = direct.shape[-1]
        # In the order it is written in.
        out = np.zeros((*direct.shape[:-1], TAPS + self.taps, count))
        row = 0
        for signal, delays in ((direct, TAPS), (once, self.taps)):
            for j in range(delays):
                out[..., row, j:] = signal[..., :count - j]
                row += 1
        return np.swapaxes(out, -1, -2)

    def responses(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Delta for each xi at the points z (M,), shape (M, K)."""
        back = 1.0 / z
        filtered = self.gain / np.polyval(self.stable[::-1], back)
        columns = [
            (1.0 - back) * factor * back**j
            for factor, delays in ((1.0, TAPS), (filtered, self.taps)) for j in range(delays)
        ]
        return np.asarray(np.array(columns, dtype=np.complex128).T @ self.spread)


class ErrorFilter:
    """The filters F_i with their state: what comes in pieces comes out as if it were one.

    signals: S, how many are filtered beside each other.
    """

    def __init__(self, error: ErrorModel, signals: int) -> None:
        self._error = error
        self._once = np.zeros((signals, error.taps))
        self._past: Array = np.zeros((2, signals, max(error.taps, TAPS) - 1))

    def filtered(self, direct: Array) -> Array:
        """Responses to the next samples (S, N), shape (S, N, n + 2)."""
        error, taps = self._error, self._error.taps
        once = direct
        if taps:
            once, self._once = lfilter([error.gain], error.stable, direct, zi=self._once)
        memory = self._past.shape[2]
        longer = np.concatenate([self._past, [direct, once]], axis=2)
        self._past = longer[..., longer.shape[2] - memory:]
        out = np.empty((len(direct), TAPS + taps, direct.shape[1]))
        row = 0
        for signal, delays in zip(longer, (TAPS, taps), strict=True):
            for j in range(delays):
                out[:, row] = signal[:, memory - j:signal.shape[1] - j]
                row += 1
        return np.swapaxes(out, 1, 2)


@lru_cache(maxsize=8)
def build_error_model(model: StateModel, uncertainty: float) -> ErrorModel:
    """The error model of a G, remembered."""
    return ErrorModel(model, uncertainty)


def _delay(model: TransferFunction, stable: Array) -> float:
    """Delay of slow motion in G without its integrators, one sample at least [samples]."""
    b = model.numerator
    of_zeros, of_poles = (
        float(np.arange(len(one)) @ one / one.sum()) if one.sum() else 0.0 for one in (b, stable)
    )
    return max(of_zeros - of_poles, 1.0)
