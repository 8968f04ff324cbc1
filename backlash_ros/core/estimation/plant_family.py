"""The linear plants that G(z) may be: G(z; xi), with exact gain at rest.

    G(z; xi) = z^-d ((1 - f) + f z^-1) [B + xi_w w (1 - z^-1)^2 B'] A(1)/A_nominal(1) / (A I)

xi (K,) are the unknowns in units of their prior deviations: where G integrates, the leak of an
integrator; the lag (d + f samples beside the nominal delay), the width of the response, and
ln Omega, ln D of every section s^2 + 2 D Omega s + Omega^2 of two poles (a real pair is D >= 1, so
that there is no edge), ln of a single real pole. The gain at rest stays in the slope m.

What acts a part t of a sample late has the lag t and the width -t (1 - t) / 2: B' is B one sample
shorter, and w = 1/8 the widest. Poles at 0, on the negative axis or outside of the unit circle
stay where they are.
"""

from __future__ import annotations

from math import cos, cosh, exp, floor, log, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.state_model import memory_of
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

LEAK = 5e-3  # prior deviation of the leak of an integrator, per sample and unit of uncertainty


class PlantFamily:
    """G(z; xi) around a nominal G.

    model: the nominal G. uncertainty: relative prior deviation r of its frequencies, damping ratios
    and delay; 0 where G is exact. count: K, 0 where G is exact. leaks: how many of the first xi are
    leaks, whose size says nothing of how wrong the rest of G is. integrates: whether
    it has a pole at 1. memory: samples after which the
    slowest stable mode has died out, within reason.
    """

    def __init__(self, model: TransferFunction, uncertainty: float) -> None:
        widest = 0.125  # width of what acts half a sample late
        b = np.trim_zeros(model.numerator, 'f')
        self.model, self.uncertainty = model, uncertainty
        self._delay = len(model.denominator) - len(b)
        poles = model.poles
        integrators = abs(poles - 1.0) < ON_CIRCLE
        moving = (abs(poles) > ON_CIRCLE) & (abs(poles) < 1.0 - ON_CIRCLE)
        moving &= ~((poles.imag == 0.0) & (poles.real < 0.0))
        fixed = ~integrators & ~moving & (abs(poles) > ON_CIRCLE)
        self._integrators = int(integrators.sum())
        self._fixed: list[float] = np.real(np.poly(poles[fixed])).tolist() if fixed.any() else [1.0]
        self._pairs, self._nominal = _sections(poles[moving])
        a = self._stable(self._nominal)
        self._gain = sum(a)
        late = max(self._delay + _mean(b.tolist()) - _mean(a), 1.0)
        self._scales: list[float] = []
        if uncertainty > 0.0:
            leak = [LEAK * uncertainty] if self._integrators else []
            self._scales = [
                *leak, uncertainty * late, widest, *([uncertainty] * len(self._nominal))
            ]
        self.leaks = int(bool(self._scales) and self._integrators > 0)
        self.count = len(self._scales)
        self.integrates = self._integrators > 0
        shorter = np.atleast_1d(np.poly([-1.0] * max(len(b) - 2, 0)))
        wide = np.convolve(shorter * b.sum() / shorter.sum(), [1.0, -2.0, 1.0])
        self._b, self._wide = b.tolist(), wide.tolist()
        slowest = max((abs(pole) for pole in poles[moving]), default=0.0)
        self.memory = memory_of(slowest)

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        """b and a of y(k) = sum b_i u(k-i) - sum a_i y(k-i), of one length.

        y(k) is the output after the interval over which u(k) acted, so that b_0 is what acts with
        the smallest delay there is.
        """
        most_leak = 0.1  # per sample
        furthest = 3.0  # by which ln Omega and ln D may be off, at most
        latest = 40.0  # samples of lag, at most
        lag = width = leak = 0.0
        logs = self._nominal
        if self.count:
            moved = [x * scale for x, scale in zip(xi, self._scales, strict=True)]
            if self.leaks:
                leak = min(max(moved.pop(0), -most_leak), most_leak)
            lag, width, *apart = moved
            logs = [
                x + min(max(dx, -furthest), furthest) for x, dx in zip(logs, apart, strict=True)
            ]
        a = self._stable(logs)
        lag = min(max(lag, -latest), latest)
        whole = max(floor(lag), 1 - self._delay)
        late, gain = [1.0 - lag + whole, lag - whole], sum(a) / self._gain
        b, wide = _product(self._b, late), _product(self._wide, late)
        b += [0.0] * (len(wide) - len(b))
        wide += [0.0] * (len(b) - len(wide))
        b = [0.0] * (self._delay + whole - 1) + [
            gain * (x + width * y) for x, y in zip(b, wide, strict=True)
        ]
        a = _product(a, self._fixed)
        for i in range(self._integrators):
            a = _product(a, [1.0, -1.0 + (leak if i == 0 else 0.0)])
        while not self.count and not b[-1]:  # the same length at every xi, where there are any
            b.pop()
        length = max(len(a), len(b))
        return b + [0.0] * (length - len(b)), a + [0.0] * (length - len(a))

    def slopes(self, xi: list[float]) -> tuple[Array, Array]:
        """Derivatives of b and a by each xi, both of shape (K, n + 1)."""
        slope_step = 1e-5  # of xi, for the derivatives of the coefficients
        rows = []
        for j in range(self.count):
            ends = []
            for step in (slope_step, -slope_step):
                moved = list(xi)
                moved[j] += step
                ends.append(self.at(moved))
            rows.append(ends)
        length = max((len(b) for ends in rows for b, _ in ends), default=1)
        out = np.zeros((2, self.count, length))
        for j, ((b1, a1), (b0, a0)) in enumerate(rows):
            for part, above, below in ((0, b1, b0), (1, a1, a0)):
                out[part, j, :len(above)] += above
                out[part, j, :len(below)] -= below
        out /= 2.0 * slope_step
        return out[0], out[1]

    def model_at(self, xi: list[float]) -> TransferFunction:
        """G(z; xi) as a transfer function."""
        b, a = self.at(xi)
        numerator = np.trim_zeros(np.array([0.0, *b]), 'b')
        denominator = np.trim_zeros(np.array(a), 'b')
        length = max(len(numerator), len(denominator))
        return TransferFunction(
            np.pad(numerator, (0, length - len(numerator))).tolist(),
            np.pad(denominator, (0, length - len(denominator))).tolist(),
        )

    def response_slopes(self, xi: list[float], z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Derivatives of ln G(z; xi) by each xi at the points z (M,), shape (M, K)."""
        b, a = self.at(xi)
        db, da = self.slopes(xi)
        powers = 1.0 / z[:, None] ** np.arange(max(len(b), db.shape[1]))
        of_b, of_a = powers[:, :len(b)] @ np.array(b), powers[:, :len(a)] @ np.array(a)
        slopes = powers[:, :db.shape[1]]
        return np.asarray(slopes @ db.T / of_b[:, None] - slopes @ da.T / of_a[:, None])

    def _stable(self, logs: list[float]) -> list[float]:
        """Denominator of the poles that may move, from ln Omega, ln D of pairs, ln of the rest."""
        a = [1.0]
        for i in range(self._pairs):
            omega, damping = exp(logs[2 * i]), exp(logs[2 * i + 1])
            r = exp(-omega * damping)
            if damping < 1.0:
                middle = cos(omega * sqrt(1.0 - damping * damping))
            else:
                middle = cosh(omega * sqrt(damping * damping - 1.0))
            a = _product(a, [1.0, -2.0 * r * middle, r * r])
        for value in logs[2 * self._pairs:]:
            a = _product(a, [1.0, -exp(-exp(value))])
        return a


def _sections(poles: NDArray[np.complex128]) -> tuple[int, list[float]]:
    """Number of pairs, and ln Omega, ln D of each, then ln of a real pole that is left over."""
    s = np.log(poles.astype(complex))
    pairs = [(abs(x), -x.real / abs(x)) for x in s if x.imag > 1e-9]
    real = sorted(-x.real for x in s if abs(x.imag) <= 1e-9)
    while len(real) > 1:
        fast, next_to_it = real.pop(), real.pop()
        omega = sqrt(fast * next_to_it)
        pairs.append((omega, (fast + next_to_it) / 2.0 / omega))
    return len(pairs), [log(q) for pair in pairs for q in pair] + [log(q) for q in real]


def _product(x: list[float], y: list[float]) -> list[float]:
    """Coefficients of the product of two polynomials: for so few, faster than np.convolve."""
    out = [0.0] * (len(x) + len(y) - 1)
    for i, p in enumerate(x):
        for j, q in enumerate(y):
            out[i + j] += p * q
    return out


def _mean(taps: list[float]) -> float:
    """Delay of slow motion in taps [samples]."""
    gain = sum(taps)
    return sum(i * tap for i, tap in enumerate(taps)) / gain if gain else 0.0
