"""The linear plants that G(z) may be: G(z; xi), with exact gain at rest.

    G(z; xi) = z^-d [B (1 - f + f z^-1) + xi_w w (1 - z^-1)^2 B'] A(1)/A_nominal(1) / (A I)

xi (K,) are the unknowns in units of their prior deviations: where G integrates, the leak of an
integrator; the lag (d + f samples beside the nominal delay, d whole), the width of the response,
and ln Omega, ln D of every section s^2 + 2 D Omega s + Omega^2 of two poles (a real pair is D >= 1,
so that there is no edge), ln of a single real pole. The gain at rest stays in the slope m.

What acts a part t of a sample late has the lag t and the width -t (1 - t) / 2: B' is B one sample
shorter, and w = 1/8 the widest. With two poles, lag and width make every numerator that a dead time
or another Omega can give. Poles at 0, on the negative axis or outside of the unit circle stay where
they are.
"""

from __future__ import annotations

from math import cos, cosh, exp, floor, inf, log, sin, sinh, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import TransferFunction, memory_of

Array = NDArray[np.float64]

LEAK = 5e-3  # prior deviation of the leak of an integrator, per sample and unit of uncertainty


class Family(Protocol):
    """Plants b / a that a fit chooses from, by K = count unknowns xi.

    leaks: how many of the first xi have a prior of deviation 1 each; the others share a scale.
    """

    @property
    def count(self) -> int:
        """K."""

    @property
    def leaks(self) -> int:
        """See above."""

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        """b and a of y(k) = sum b_i u(k-i) - sum a_i y(k-i), of one length.

        y(k) is the output after the interval over which u(k) acted, so that b_0 is what acts with
        the smallest delay there is.
        """

    def slopes(self, xi: list[float]) -> tuple[Array, Array]:
        """Derivatives of b and a by each xi, both of shape (K, n + 1)."""


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
        a = _product(*(section for section, _ in self._sections_at(self._nominal)))
        self._gain = sum(a)
        late = max(self._delay + _mean(b.tolist()) - _mean(a), 1.0)
        self._scales: list[float] = []
        self._limits: list[float] = []  # of what is moved by xi
        if uncertainty > 0.0:
            # A leak of 0.1 a sample, a lag of 40 samples, a factor of 20 on Omega and D.
            leak = [LEAK * uncertainty] if self._integrators else []
            self._scales = [
                *leak, uncertainty * late, widest, *([uncertainty] * len(self._nominal))
            ]
            self._limits = [*([0.1] * len(leak)), 40.0, inf, *([3.0] * len(self._nominal))]
        self.leaks = int(bool(self._scales) and self._integrators > 0)
        self.count = len(self._scales)
        self.integrates = self._integrators > 0
        shorter = np.atleast_1d(np.poly([-1.0] * max(len(b) - 2, 0)))
        wide = np.convolve(shorter * b.sum() / shorter.sum(), [1.0, -2.0, 1.0])
        self._b, later, self._wide = (
            np.pad(taps, (0, max(len(b) + 1, 3) - len(taps))).tolist()
            for taps in (b, np.append(0.0, b), wide)
        )
        self._move = [x - y for x, y in zip(later, self._b, strict=True)]
        slowest = max((abs(pole) for pole in poles[moving]), default=0.0)
        self.memory = memory_of(slowest)

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        leak, lag, width, logs = self._moved(xi)
        stable = _product(*(section for section, _ in self._sections_at(logs)))
        gain, rest = sum(stable) / self._gain, self._rest([1.0, -1.0 + leak])
        whole, taps = self._taps(lag, width)
        b = [0.0] * (self._delay + whole - 1) + [gain * tap for tap in taps]
        a = _product(stable, rest)
        while not self.count and not b[-1]:  # the same length at every xi, where there are any
            b.pop()
        length = max(len(a), len(b))
        return b + [0.0] * (length - len(b)), a + [0.0] * (length - len(a))

    def slopes(self, xi: list[float]) -> tuple[Array, Array]:
        leak, lag, width, logs = self._moved(xi)
        sections = self._sections_at(logs)
        stable = _product(*(section for section, _ in sections))
        gain, rest = sum(stable) / self._gain, self._rest([1.0, -1.0 + leak])
        whole, taps = self._taps(lag, width)
        rows: list[tuple[list[float], list[float]]] = []  # b without its first zeros, and a
        if self.leaks:
            rows.append(([], _product(stable, self._rest([0.0, 1.0]))))
        rows += [([gain * x for x in of_b], []) for of_b in (self._move, self._wide)]
        for i, (_, slopes) in enumerate(sections):
            others = [section for k, (section, _) in enumerate(sections) if k != i]
            for slope in slopes:
                moved = _product(slope, *others)
                of_gain = sum(moved) / self._gain
                rows.append(([of_gain * tap for tap in taps], _product(moved, rest)))
        zeros = self._delay + whole - 1
        out = np.zeros((2, self.count, max(zeros + len(taps), len(stable) + len(rest) - 1)))
        for j, (of_b, of_a) in enumerate(rows[:self.count]):
            free = abs(xi[j] * self._scales[j]) < self._limits[j]
            out[0, j, zeros:zeros + len(of_b)] = of_b
            out[1, j, :len(of_a)] = of_a
            out[:, j] *= self._scales[j] * free
        return out[0], out[1]

    def _moved(self, xi: list[float]) -> tuple[float, float, float, list[float]]:
        """Leak, lag and width, and ln Omega, ln D of pairs, ln of the rest."""
        if not self.count:
            return 0.0, 0.0, 0.0, self._nominal
        moved = [
            min(max(x * scale, -limit), limit)
            for x, scale, limit in zip(xi, self._scales, self._limits, strict=True)
        ]
        leak = moved.pop(0) if self.leaks else 0.0
        return leak, moved[0], moved[1], [
            x + apart for x, apart in zip(self._nominal, moved[2:], strict=True)
        ]

    def _taps(self, lag: float, width: float) -> tuple[int, list[float]]:
        """Whole samples of the lag, and the numerator beside them, with the nominal gain."""
        whole = max(floor(lag), 1 - self._delay)
        part = lag - whole
        return whole, [
            x + part * dx + width * y
            for x, dx, y in zip(self._b, self._move, self._wide, strict=True)
        ]

    def _rest(self, integrator: list[float]) -> list[float]:
        """Denominator of the poles that do not move but for a leak, the first integrator given."""
        if not self._integrators:
            return self._fixed
        return _product(self._fixed, integrator, *([[1.0, -1.0]] * (self._integrators - 1)))

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

    def _sections_at(self, logs: list[float]) -> list[tuple[list[float], list[list[float]]]]:
        """Denominators of the poles that may move, each with its derivatives by its logs."""
        out = []
        for i in range(self._pairs):
            omega, damping = exp(logs[2 * i]), exp(logs[2 * i + 1])
            r, square = exp(-omega * damping), omega * omega * (1.0 - damping * damping)
            angle = sqrt(abs(square))
            middle, sinc = (cos(angle), sin(angle)) if square > 0.0 else (cosh(angle), sinh(angle))
            sinc = sinc / angle if angle > 1e-9 else 1.0
            shrink, turns = -omega * damping, (-sinc * square, sinc * (omega * damping) ** 2)
            out.append(([1.0, -2.0 * r * middle, r * r], [
                [0.0, -2.0 * r * (shrink * middle + turn), 2.0 * shrink * r * r] for turn in turns
            ]))
        for value in logs[2 * self._pairs:]:
            pole = exp(-exp(value))
            out.append(([1.0, -pole], [[0.0, exp(value) * pole]]))
        return out


def filtered(b: list[float], a: list[float], u: Array, x: Array) -> Array:
    """Output of the filter b / a from the state x before u (N,)."""
    return lfilter(b, a, u, padded(x, len(a) - 1))


def padded(x: Array, length: int) -> Array:
    """The first values of x, and zeros behind them, (length,)."""
    out = np.zeros(length)
    out[:min(length, len(x))] = x[:length]
    return out


def state_columns(a: list[float], count: int) -> Array:
    """How outputs depend on the state before them, shape (count, order)."""
    impulse = np.zeros(count)
    impulse[0] = 1.0
    once = lfilter([1.0], a, impulse)
    return np.column_stack([np.zeros((count, 0)), *(
        np.concatenate([np.zeros(i), once[:count - i]]) for i in range(len(a) - 1)
    )])


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


def _product(*factors: list[float]) -> list[float]:
    """Coefficients of a product of polynomials: for so few, faster than np.convolve."""
    product = [1.0]
    for factor in factors:
        out = [0.0] * (len(product) + len(factor) - 1)
        for i, x in enumerate(product):
            for j, y in enumerate(factor):
                out[i + j] += x * y
        product = out
    return product


def _mean(taps: list[float]) -> float:
    """Delay of slow motion in taps [samples]."""
    gain = sum(taps)
    return sum(i * tap for i, tap in enumerate(taps)) / gain if gain else 0.0
