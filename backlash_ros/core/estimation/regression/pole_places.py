"""Where the poles of G may be: natural frequencies, damping ratios and time constants.

A pole exp(-lambda) is told by the logarithm of lambda, its frequency in radians per sample. Two
poles lambda = omega exp(+-sqrt(w)) are told by log omega and w: w < 0 for a complex pair with the
damping ratio cos(sqrt(-w)), w > 0 for a real one, and everything is smooth where one turns into
the other.
"""

from __future__ import annotations

from math import atan2, cos, exp, hypot, log, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import BY_CHANCE
from backlash_ros.core.plant.model_check import ON_CIRCLE

Array = NDArray[np.float64]

STEP = 1e-4  # of a place, for a derivative


class PolePlaces:
    """Places around poles (n,) inside the unit circle, as far off as `spread` says, relatively.

    A place is given by numbers of which each has the deviation 1, and 0 where it was told: shape
    (told,), where negative poles, which no continuous-time pole gives, have none.
    """

    def __init__(self, poles: NDArray[np.complex128], spread: float) -> None:
        upper = [pole for pole in poles if pole.imag > 0.0]
        logs = sorted(log(-log(pole.real)) for pole in poles if pole.imag == 0.0 < pole.real)
        self._fixed = [pole.real for pole in poles if pole.imag == 0.0 and pole.real <= 0.0]
        singles: list[float] = []
        pairs = [(log(abs(np.log(pole))), -_angle(pole) ** 2) for pole in upper]
        scales = [(spread, _spread_of_damping(w, spread)) for _, w in pairs]
        alone = spread / sqrt(2.0)
        while logs:
            fast = logs.pop()
            # Two that may be one and the same.
            if logs and fast - logs[-1] < BY_CHANCE * sqrt(2.0) * spread:
                slow = logs.pop()
                x = 0.5 * (fast - slow)
                pairs.append((0.5 * (fast + slow), x * x))
                scales.append((alone, hypot(2.0 * x * alone, sqrt(2.0) * alone**2)))
            else:
                singles.append(fast)
        self._single = len(singles)
        self.told: Array = np.array([*singles, *(value for pair in pairs for value in pair)])
        self._scales: Array = np.array(
            [*(spread for _ in singles), *(scale for both in scales for scale in both)]
        )

    def denominator(self, xi: Array) -> Array | None:
        """Monic polynomial of the poles at this place; None where one of them is not stable."""
        values = (self.told + self._scales * xi).tolist()
        a: Array = np.ones(1)
        for pole in self._fixed:
            a = np.asarray(np.convolve(a, (1.0, -pole)))
        for value in values[:self._single]:
            decay = float(np.exp(value))
            if decay < ON_CIRCLE:
                return None
            a = np.asarray(np.convolve(a, (1.0, -exp(-decay))))
        pairs = values[self._single:]
        for log_omega, w in zip(pairs[::2], pairs[1::2], strict=True):
            section = _section(float(np.exp(log_omega)), w)
            if section is None:
                return None
            a = np.asarray(np.convolve(a, section))
        return a

    def distance(self, xi: Array) -> float:
        """Largest move of a place, as a logarithm, for a difference xi (K,)."""
        return float(np.abs(self._scales * xi).max(initial=0.0))

    def slopes(self, xi: Array) -> list[Array]:
        """Derivatives of the denominator by each of xi (K,)."""
        slopes = []
        for step in STEP * np.eye(len(xi)):
            there, back = self.denominator(xi + step), self.denominator(xi - step)
            assert there is not None
            assert back is not None
            slopes.append((there - back) / (2.0 * STEP))
        return slopes


def _section(omega: float, w: float) -> tuple[float, float, float] | None:
    """Polynomial of two poles; None where one of them is not stable."""
    if w < 0.0:
        angle = sqrt(-w)
        decay = omega * cos(angle)
        if angle > pi or decay < ON_CIRCLE:
            return None
        return 1.0, -2.0 * exp(-decay) * cos(omega * sin(angle)), exp(-2.0 * decay)
    ratio = float(np.exp(sqrt(w)))  # inf where one of them is that fast
    fast, slow = omega * ratio, omega / ratio
    if slow < ON_CIRCLE:
        return None
    return 1.0, -exp(-fast) - exp(-slow), exp(-fast - slow)


def _angle(pole: complex) -> float:
    """Of a pole's lambda, whose cosine is the damping ratio; never 0 for a complex one."""
    s = np.log(pole)
    return atan2(s.imag, -s.real)


def _spread_of_damping(w: float, spread: float) -> float:
    """Deviation of w for one of the damping ratio, relatively."""
    angle = sqrt(-w)
    return 2.0 * angle * spread * cos(angle) / sin(angle)
