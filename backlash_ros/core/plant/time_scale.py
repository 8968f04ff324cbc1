"""The numerator of a sampled plant G(z) whose continuous G(s) becomes faster or slower."""

from math import copysign, log

import numpy as np

from backlash_ros.core.plant.transfer_function import ON_CIRCLE, Array, Roots, TransferFunction

FASTER = log(2.0)  # largest |x|; a larger one has the same effect
DEGREE = 8  # of the polynomials of x, which err by some 1e-7 of b
TOGETHER = 1e-3  # relative distance of rates below which poles count as one: rounding splits them


class ScaledNumerator:
    """Numerator B(x) of G(s e^-x) = B/A sampled with u held; its sum does not change.

    b: at x = 0, from the first effect on y on, (M,). poles: of G(z), none at 0 or on the negative
    axis, (P,). early: samples by which B(x) begins before b. B is always b if that has more than P
    coefficients, or poles lie too close to each other.
    """

    def __init__(self, b: Array, poles: Roots) -> None:
        self.early = max(len(poles) - len(b), 0)
        begun = np.append(np.zeros(self.early), b)
        powers = begun[None] if len(begun) > len(poles) else _polynomials(begun, poles)
        if not np.abs(powers[-1] - begun).max() <= 1e-4 * np.abs(b).max():
            self.early, powers, begun = 0, b[None], b
        powers[-1] = begun
        self._powers: list[list[float]] = powers.tolist()  # of x, the highest first

    def at(self, x: complex) -> list[complex]:
        """B(x), (early + M,); x may be complex, for derivatives by a complex step."""
        x = x if abs(x.real) < FASTER else copysign(FASTER, x.real)
        b = [0j] * len(self._powers[0])
        for power in self._powers:
            b = [value * x + each for value, each in zip(b, power, strict=True)]
        return b


def _polynomials(b: Array, poles: Roots) -> Array:
    """B(x) of b (P,) by powers of x, the highest first: (DEGREE + 1, P)."""
    n, model = len(poles), TransferFunction(b.tolist(), np.real(np.poly(poles)).tolist())
    x = [0.0] * n
    response = np.array([0.0, *(model.advance(x, 1.0) for _ in range(n))])
    # The step response is a sum of exponentials of t, times powers of t for poles that coincide.
    rates = np.log(np.append(poles, 1.0).astype(complex))
    modes, power, t = rates.copy(), np.zeros(n + 1, dtype=int), np.arange(n + 1)[:, None]
    for i, mode in enumerate(rates):
        alike = np.flatnonzero(np.abs(modes[:i] - mode) < TOGETHER * abs(mode) + ON_CIRCLE)
        if alike.size:
            modes[i], power[i] = modes[alike[0]], alike.size
    weights = np.linalg.lstsq(np.exp(t * modes) * t**power, response, rcond=None)[0]
    nodes = FASTER * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))  # Chebyshev
    values = np.zeros((DEGREE + 1, n))
    for row, s in zip(values, np.exp(nodes), strict=True):
        response = np.real(np.exp(s * t * modes) * (s * t) ** power @ weights)
        row[:] = np.convolve(np.real(np.poly(np.exp(s * rates[:-1]))), np.diff(response))[:n]
        row *= b.sum() / row.sum()
    return np.linalg.solve(np.vander(nodes), values)
