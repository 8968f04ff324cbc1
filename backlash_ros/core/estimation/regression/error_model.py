"""How wrong G may be: its poles, its delay, and how its numerator spreads.

With A the polynomial of the moving poles of G = b/a, neither integrators nor delays, n of them,

    G_true = A(1)/A'(1) A/A' [G (1 - (1 - z^-1) lag) + (1 - z^-1)^2 width B/a] = G (1 + Delta)

where the poles of A' are off in natural frequency, damping ratio or time constant
(pole_places.py), and B is b one sample shorter. What acts a part t of a sample late has the lag t
and the width -t (1 - t) / 2: for G of second order that is all of it. Nothing has a gain at rest,
so that the DC gain (the velocity gain of an integrating G) stays in m. To first order in xi, the
unknowns in units of their deviations,

    Delta = (1 - z^-1) sum_i h_i F_i(z),   h = L xi,
    F = -1, (1 - z^-1) B/b, z^-j A(1)/A for j = 0 .. n-1

The fit moves the poles and the delay of G until first order is all there is (relabelling.py). The
prior stays that of the G that was told; its scale is learned (posterior.py).
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from math import floor, log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import LEAK
from backlash_ros.core.estimation.regression.pole_places import PolePlaces
from backlash_ros.core.plant.filtering import lfilter
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

FURTHEST = log(2.0)  # logarithm of a time constant that is moved by at once, at most
ALMOST_ONE = 0.75  # samples of lag from which on it is one of the delay
BEYOND = 0.1  # samples by which the lag of a moved G may be less than 0, or more than 1
WIDEST = 0.125  # of what acts a part of a sample late, t (1 - t) / 2
TAPS = 2  # unknowns of the numerator: lag and width
MOST_LATE = 2  # samples of delay that G moves by at once, at most


class ErrorModel:
    """Filters F_i of a model G, and the prior of their coefficients.

    model: G, which may have been moved from the one that was told. uncertainty: as told. stable:
    A, monic. gain: A(1). taps: n. count: number K of unknowns, 0 where G is exact. leak: prior
    deviation of that of an integrator, per sample. spread: L, shape (n + 2, K). told: xi of the G
    that was told, which the prior is around, shape (K,). b, wide: b and (1 - z^-1) B, after a delay
    of one sample. later: whole samples that G acts later than told.
    """

    def __init__(self, model: StateModel, uncertainty: float) -> None:
        self.uncertainty = uncertainty
        self.model = model
        transfer = model.transfer_function
        self._told_delay = transfer.delay
        self._told_b = np.trim_zeros(transfer.numerator, 'fb')
        poles = transfer.poles
        moving = poles[(np.abs(poles) > ON_CIRCLE) & (np.abs(poles) < 1.0 - ON_CIRCLE)]
        self._places = PolePlaces(moving, uncertainty)
        integrators = int(np.count_nonzero(np.abs(poles - 1.0) < ON_CIRCLE))
        self._integrate = np.atleast_1d(np.poly([1.0] * integrators))
        self.taps = len(moving)
        self.integrates = integrators > 0
        self.leak = LEAK * uncertainty if self.integrates else 0.0
        self.count = TAPS + len(self._places.told) if uncertainty > 0.0 else 0
        self.told: Array = np.zeros(self.count)
        self.later = 0
        self.stable: Array = np.atleast_1d(np.real(np.poly(moving)))
        self._told_gain = float(self.stable.sum())
        late = max(self._told_delay + _mean(self._told_b) - _mean(self.stable), 1.0)
        self._of_taps = np.array([uncertainty * late, WIDEST])
        self._follow()

    def _follow(self) -> None:
        """Set what follows from A and what was told."""
        self.gain = float(self.stable.sum())
        self.b, self.wide = self._numerators(self.gain)
        self.spread = np.zeros((TAPS + self.taps, self.count))
        if self.count:
            self.spread[:TAPS, :TAPS] = np.diag(self._of_taps)
            for column, slope in enumerate(self._places.slopes(-self.told[TAPS:]), TAPS):
                # d ln(A(1)/A) has a zero at z = 1, which is divided out.
                numerator = self.stable * (float(slope.sum()) / self.gain) - slope
                self.spread[TAPS:, column] = np.cumsum(numerator)[:-1] / self.gain

    def _numerators(self, gain: float) -> tuple[Array, Array]:
        """b and (1 - z^-1) B for A(1)."""
        b = self._told_b * (gain / self._told_gain)
        shorter = np.atleast_1d(np.poly([-1.0] * max(len(b) - 2, 0)))
        wide = np.convolve(shorter * float(b.sum() / shorter.sum()), (1.0, -1.0))
        return b, np.asarray(wide, dtype=np.float64)

    def moved(self, xi: Array) -> ErrorModel:
        """The same prior around the G at xi (K,).

        But its poles no further than first order holds, and where some would leave the unit circle
        all go half as far. What acts up to a sample late has a lag from 0 to 1.
        """
        told = self.told[TAPS:]
        share = min(FURTHEST / max(self._places.distance(xi[TAPS:]), FURTHEST), 1.0)
        denominator = self._places.denominator(share * xi[TAPS:] - told)
        while denominator is None:
            share *= 0.5
            denominator = self._places.denominator(share * xi[TAPS:] - told)
        lag, _ = self._taps_at(share * xi)
        late = 0 if abs(lag - 0.5) <= 0.5 + BEYOND else floor(lag)
        return self._around(denominator, self.later + max(late, 1 - self.delay), share * xi)

    def delayed(self, xi: Array) -> ErrorModel:
        """The same with whole samples of delay more or less, where the lag at xi (K,) is one."""
        lag = float(self._of_taps[0] * xi[0])
        late = 0 if abs(lag) < ALMOST_ONE else max(min(round(lag), MOST_LATE), -MOST_LATE)
        late = max(late, 1 - self.delay)
        if late == 0:
            return self
        apart = np.zeros(self.count)
        apart[0] = late / self._of_taps[0]
        return self._around(self.stable, self.later + late, apart)

    @property
    def delay(self) -> int:
        """Samples after which G answers."""
        return self._told_delay + self.later

    def _taps_at(self, xi: Array) -> tuple[float, float]:
        """Lag [samples] beside the delay, and width, of the G at xi (K,)."""
        lag, width = (self._of_taps * (xi - self.told)[:TAPS]).tolist()
        return lag - self.later, width

    def _around(self, denominator: Array, later: int, apart: Array) -> ErrorModel:
        """Around another G, whose xi is `apart` (K,)."""
        other = copy(self)
        other.stable, other.later = denominator, later
        other.told = self.told - apart
        other._follow()
        taps = other._taps_at(np.zeros(self.count))
        other.model = StateModel(other._transfer_function(denominator, *taps))
        return other

    def low_order(self, xi: Array) -> TransferFunction | None:
        """The G at xi (K,); None where it is not stable."""
        denominator = self._places.denominator(xi[TAPS:] - self.told[TAPS:])
        if denominator is None:
            return None
        return self._transfer_function(denominator, *self._taps_at(xi))

    def _transfer_function(self, stable: Array, lag: float, width: float) -> TransferFunction:
        """G with these moving poles, this lag and this width."""
        b: Array
        b, wide = self._numerators(float(stable.sum()))
        if lag or width:
            late = np.convolve(b, (1.0 - lag, lag))
            wider = width * np.convolve(wide, (1.0, -1.0))
            b = np.pad(late, (0, len(wider) - len(late))) + wider
        a = np.convolve(stable, self._integrate)
        order = max(len(a) - 1, self.delay + len(b) - 1)
        numerator, denominator = np.zeros(order + 1), np.zeros(order + 1)
        numerator[self.delay:self.delay + len(b)], denominator[:len(a)] = b, a
        return TransferFunction(numerator.tolist(), denominator.tolist())

    def responses(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Delta for each xi at the points z (M,), shape (M, K)."""
        back = 1.0 / z
        moved = np.polyval(self.model.transfer_function.numerator[:self.delay - 1:-1], back)
        lag, wide = (np.polyval(taps[::-1], back) / moved for taps in (-self.b, self.wide))
        filtered = self.gain / np.polyval(self.stable[::-1], back)
        columns = [lag, wide, *(filtered * back**j for j in range(self.taps))]
        of_unknowns = np.array(columns, dtype=np.complex128).T @ self.spread
        return np.asarray((1.0 - back)[:, None] * of_unknowns)


class ErrorFilter:
    """G F_i with their state: what comes in pieces comes out as if it were one.

    signals: S, how many are filtered beside each other.
    """

    def __init__(self, error: ErrorModel, signals: int) -> None:
        self._error = error
        model = error.model.transfer_function
        # Without its first sample, which is always 0, a response is that after each sample.
        delay: Array = np.zeros(error.delay - 1)
        numerators = [
            np.append(delay, -error.b), np.append(delay, error.wide), model.numerator[1:],
        ]
        self._filters = [
            (b, model.denominator, np.zeros((signals, max(len(b), model.order + 1) - 1)))
            for b in numerators
        ]
        self._once: Array = np.zeros((signals, error.taps))
        self._past: Array = np.zeros((signals, max(error.taps - 1, 0)))

    def responses(self, moves: Array) -> Array:
        """How y after each of the next moves of p (S, N) depends on every xi, shape (S, K, N)."""
        error, memory = self._error, self._past.shape[1]
        out = np.empty((len(moves), TAPS + error.taps, moves.shape[1]))
        for row, (b, a, state) in enumerate(self._filters[:TAPS]):
            out[:, row], state[:] = lfilter(b, a, moves, zi=state)
        if error.taps:
            b, a, state = self._filters[TAPS]
            response, state[:] = lfilter(b, a, moves, zi=state)
            once, self._once = lfilter([error.gain], error.stable, response, zi=self._once)
            longer = np.concatenate([self._past, once], axis=1)
            self._past = longer[:, longer.shape[1] - memory:]
            for j in range(error.taps):
                out[:, TAPS + j] = longer[:, memory - j:longer.shape[1] - j]
        return np.asarray(error.spread.T @ out)


@lru_cache(maxsize=8)
def build_error_model(model: StateModel, uncertainty: float) -> ErrorModel:
    """The error model of a G, remembered."""
    return ErrorModel(model, uncertainty)


def _mean(taps: Array) -> float:
    """Delay of slow motion in taps (N,) [samples]."""
    gain = float(taps.sum())
    return float(np.arange(len(taps)) @ taps) / gain if gain else 0.0
