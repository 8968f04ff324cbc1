"""How wrong G may be: G_true = G (1 + Delta) with a prior drawn from plants around G.

    Delta(z) = (1 - z^-1) sum_i h_i F_i(z)

has no gain at rest, so that the DC gain (the velocity gain of an integrating G) stays in m. With A
the stable poles of G, scaled to A(1) = 1, and s of them, the F_i are

    1, z^-1;  z^-j / A, j = 0 .. s-1;  z^-j / A^2, j = 0 .. s-1

The prior of h comes from plants whose natural frequencies, damping ratios, time constants and
delay are off by a relative spread. Its scale is learned (posterior.py).
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.estimation.constants import FREE_TAPS, LEAK
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

DRAWN = 300  # plants that the prior is drawn from
SEED = 1  # of the drawing: the same G has the same prior
LONGEST_RESPONSE = 2000  # samples of the responses that are compared
RESPONSE_LASTS = 8.0  # slowest time constants that these responses last
MORE_TAPS = 2  # numerator taps of a G of low order beyond its moving poles: a sample of delay
# --- guards
NO_DIRECTION = 1e-7  # share of the largest singular value of the responses that is rounding


class ErrorModel:
    """Filters F_i of a model G, and the prior of their coefficients.

    stable: denominator A of the stable poles of G, monic; delays (poles at 0) are left out. count:
    number K of filters, 0 where G is exact. leak: prior deviation of that of an integrator, per
    sample. spread: factor L of the prior covariance of h at
    scale 1, L L' = cov(h), shape (K, K).
    """

    def __init__(self, model: StateModel, uncertainty: float) -> None:
        moving = _moving(model)
        self.stable: Array = monic(moving)
        self.gain = float(self.stable.sum())
        self.taps = len(moving)
        self.count = 2 + 2 * self.taps if uncertainty > 0.0 else 0
        poles = model.transfer_function.poles
        self.integrates = bool(np.any(np.abs(poles - 1.0) < ON_CIRCLE))
        self.leak = LEAK * uncertainty if self.integrates else 0.0
        self.spread: Array = np.zeros((0, 0))
        # The same as a G of low order: spread of its taps and denominator (family.py).
        self.low_order_spread: Array = np.zeros((0, 0))
        if self.count:
            self.spread, self.low_order_spread = _prior(model, self, moving, uncertainty)

    def around(self, model: StateModel) -> ErrorModel:
        """The same prior for a G of as many moving poles, in units of its own time constants.

        Where rounding has changed their number, an integrator beside slow poles being one of them,
        it stays as it is.
        """
        moving = _moving(model)
        if len(moving) != self.taps:
            return self
        other = copy(self)
        other.stable = monic(moving)
        other.gain = float(other.stable.sum())
        return other

    def filtered(self, direct: Array) -> Array:
        """Responses of the F_i to signals (..., N) that were 0 before, shape (..., N, K)."""
        once = lfilter([self.gain], self.stable, direct)
        twice = lfilter([self.gain], self.stable, once)
        count = direct.shape[-1]
        out = np.zeros((*direct.shape[:-1], self.count, count))  # in the order it is written in
        row = 0
        for signal, delays in ((direct, 2), (once, self.taps), (twice, self.taps)):
            for j in range(delays):
                out[..., row, j:] = signal[..., :count - j]
                row += 1
        return np.swapaxes(out, -1, -2)

    def responses(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(1 - z^-1) F_i at the points z (M,), shape (M, K)."""
        back = 1.0 / z
        filtered = self.gain / np.polyval(self.stable[::-1], back)
        columns = [
            (1.0 - back) * factor * back**j
            for factor, delays in ((1.0, 2), (filtered, self.taps), (filtered**2, self.taps))
            for j in range(delays)
        ][:self.count]
        return np.array(columns, dtype=np.complex128).reshape(self.count, len(z)).T


class ErrorFilter:
    """The filters F_i with their state: what comes in pieces comes out as if it were one.

    signals: S, how many are filtered beside each other.
    """

    def __init__(self, error: ErrorModel, signals: int) -> None:
        self._error = error
        self._once, self._twice = np.zeros((2, signals, error.taps))
        self._past: Array = np.zeros((3, signals, max(error.taps - 1, 1)))

    def filtered(self, direct: Array) -> Array:
        """Responses to the next samples (S, N), shape (S, N, K)."""
        error, taps = self._error, self._error.taps
        gain = [error.gain]
        if taps:
            once, self._once = lfilter(gain, error.stable, direct, zi=self._once)
            twice, self._twice = lfilter(gain, error.stable, once, zi=self._twice)
        else:
            once = twice = direct
        memory = self._past.shape[2]
        longer = np.concatenate([self._past, [direct, once, twice]], axis=2)
        self._past = longer[..., longer.shape[2] - memory:]
        out = np.empty((len(direct), error.count, direct.shape[1]))
        row = 0
        for signal, delays in zip(longer, (2, taps, taps), strict=True):
            for j in range(delays):
                out[:, row] = signal[:, memory - j:signal.shape[1] - j]
                row += 1
        return np.swapaxes(out, 1, 2)


@lru_cache(maxsize=8)
def build_error_model(model: StateModel, uncertainty: float) -> ErrorModel:
    """The error model of a G, remembered: drawing its prior takes some 50 ms."""
    return ErrorModel(model, uncertainty)


def monic(roots: NDArray[np.complex128]) -> Array:
    """Coefficients of the real polynomial with these roots, leading coefficient 1."""
    return np.atleast_1d(np.real(np.poly(roots)))


def _moving(model: StateModel) -> NDArray[np.complex128]:
    """Poles that are neither integrators nor delays."""
    poles = model.transfer_function.poles
    return poles[(np.abs(poles) > ON_CIRCLE) & (np.abs(poles) < 1.0 - ON_CIRCLE)]


def _prior(
    model: StateModel, error: ErrorModel, moving: NDArray[np.complex128], uncertainty: float,
) -> tuple[Array, Array]:
    """Spread of h over plants around G, from their step responses without integrators.

    And that of numerator taps and denominator, shape (taps + n, ..), of the stable part.
    """
    rng = np.random.default_rng(SEED)
    numerator = np.trim_zeros(model.transfer_function.numerator, 'f')
    start = model.transfer_function.delay
    slowest = max((-1.0 / np.log(np.abs(moving))).tolist(), default=1.0)
    samples = int(min(RESPONSE_LASTS * slowest + 20.0, LONGEST_RESPONSE))
    impulse = np.zeros(samples)
    impulse[start] = 1.0
    response = lfilter(numerator, error.stable, impulse)
    told = np.cumsum(response)
    delay = float(np.sum(1.0 - told / told[-1]))  # of the whole response at low frequencies
    basis = error.filtered(response)
    off = np.empty((samples, DRAWN))
    taps = len(moving) + MORE_TAPS
    coefficients = np.empty((taps + len(moving), DRAWN))
    k = np.arange(samples, dtype=float)
    for i in range(DRAWN):
        stable = monic(_moved(moving, uncertainty, rng))
        true = np.cumsum(lfilter(numerator * (stable.sum() / error.gain), stable, impulse))
        # Faster plants are among those of the poles; none answers before it is driven.
        lag = uncertainty * delay * abs(float(rng.standard_normal()))
        lagged = np.interp(k - lag, k, true, left=0.0)
        off[:, i] = lagged - told
        coefficients[:taps, i] = _taps(lagged, stable, start, taps)
        coefficients[taps:, i] = stable[1:]
    told_taps = _taps(told, error.stable, start, taps)
    coefficients -= np.append(told_taps, error.stable[1:])[:, None]
    h = np.asarray(np.linalg.lstsq(basis, off, rcond=NO_DIRECTION)[0], dtype=np.float64)
    # A lag by a part of a sample moves single taps in ways of its own.
    free = uncertainty * FREE_TAPS * float(np.abs(told_taps).max())
    taps_alone = np.eye(taps + len(moving), taps) * free
    return _root(h), np.concatenate([_root(coefficients), taps_alone], axis=1)


def _root(draws: Array) -> Array:
    """L of the second moment L L' of draws (K, DRAWN)."""
    return np.asarray(np.linalg.qr(draws.T / DRAWN**0.5, mode='r')).T


def _taps(step: Array, stable: Array, start: int, count: int) -> Array:
    """First numerator taps of a step response with the denominator `stable`."""
    impulse = np.diff(step[:start + count], prepend=0.0)
    return np.convolve(impulse, stable)[start:start + count]


def _moved(
    poles: NDArray[np.complex128], spread: float, rng: np.random.Generator,
) -> NDArray[np.complex128]:
    """Poles whose natural frequency and damping ratio are off by exp(spread N)."""
    moved: list[complex] = []
    for pole in poles:
        if pole.imag < 0.0:
            continue  # follows its conjugate
        if pole.imag == 0.0 and pole.real < 0.0:
            moved.append(complex(pole))  # no continuous-time pole of its own
            continue
        s = np.log(complex(pole))
        frequency = abs(s) * np.exp(spread * rng.standard_normal())
        if pole.imag == 0.0:
            moved.append(np.exp(-frequency))
            continue
        damping = -s.real / abs(s) * np.exp(spread * rng.standard_normal())
        root = np.sqrt(complex(damping**2 - 1.0))
        moved += [np.exp(frequency * (-damping + root)), np.exp(frequency * (-damping - root))]
    return np.asarray(moved, dtype=np.complex128)
