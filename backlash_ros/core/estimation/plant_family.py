"""The family of linear plants that G(z) may be; all have the nominal gain at rest.

    G(z; xi) = z^-i [B_x (1 - f + f z^-1) + xi_w w (1 - z^-1)^2 B'] A(1)/A_nominal(1) / (A I)

xi (K,), in units of prior standard deviations: the leak of an integrator, if G integrates; a lag of
i + f samples beyond the nominal delay, i whole; the width of the response, with w = 1/8 and B' = B
one sample shorter; ln Omega, ln D of each pair of poles, s^2 + 2 D Omega s + Omega^2; ln of a real
pole left over. B_x is B of a G(s) faster by the mean change x of ln Omega, or B if there are poles
that are kept: on the negative axis or on the unit circle. Poles at 0 are a delay.
"""

from collections.abc import Sequence
from itertools import zip_longest
from math import copysign, floor

import numpy as np

from backlash_ros.core.plant.numerics import denominator_of, multiplied, padded, sections_of
from backlash_ros.core.plant.time_scale import ScaledNumerator
from backlash_ros.core.plant.transfer_function import ON_CIRCLE, Array, TransferFunction, memory_of

# G jumps where i changes: so far below a whole number of samples, which is the most usual lag. This
# leaves at most a hundredth of a dead time unexplained.
BEFORE_WHOLE = 0.05


class PlantFamily:
    """G(z; xi) around a nominal G, the model.

    uncertainty: relative prior standard deviation of frequencies, damping and delay; with 0, K = 0.
    memory: samples until the slowest stable mode has practically died out.
    """

    def __init__(self, model: TransferFunction, uncertainty: float) -> None:
        b, poles = np.trim_zeros(model.numerator, 'f'), model.poles
        poles = poles[abs(poles) > ON_CIRCLE]
        integrators = abs(poles - 1.0) < ON_CIRCLE
        moving = ~integrators & (abs(poles) < 1.0 - ON_CIRCLE) & (abs(np.angle(poles)) < np.pi)
        self.model, self.integrates = model, bool(integrators.any())
        self.memory = memory_of(max(abs(poles[moving]), default=0.0))
        # Denominator of the poles that are kept, except the first integrator, which may leak.
        rest = np.concatenate([poles[~integrators & ~moving], poles[integrators][1:].round()])
        self._rest: list[float] = np.atleast_1d(np.real(np.poly(rest))).tolist()
        self._pairs, self._nominal = sections_of(poles[moving])
        a = [x.real for x in denominator_of(self._pairs, *self._nominal)]
        scaled = uncertainty > 0.0 and bool((moving | integrators).all())
        self._numerator = ScaledNumerator(b, poles if scaled else poles[:0])
        self._gain, self._delay = sum(a), len(model.denominator) - len(b) - self._numerator.early
        # However short G is, a lag of one sample is usual: drivers apply v, or read y, that late.
        stable = TransferFunction(b.tolist(), padded(np.array(a), len(model.denominator)).tolist())
        late = max(stable.group_delay, 5.0)
        # Prior std and limit of what each xi changes. Limits: a leak of 0.1 a sample, a lag of 40,
        # a mean over 5 samples, a factor of 20 on Omega and D. 0.125: acting half a sample late.
        self._scales = [
            *[(5e-3 * uncertainty, 0.1)] * self.integrates, (uncertainty * late, 40.0),
            (0.125, 1.0), *[(uncertainty, 3.0)] * len(self._nominal)] if uncertainty > 0.0 else []
        # The size of a leak says nothing about how wrong the rest of G is.
        self.count, self.leaks = len(self._scales), int(self.integrates and uncertainty > 0.0)
        shorter = np.poly1d([1.0, 1.0]) ** max(len(b) - 2, 0)
        wide = np.convolve(shorter * (b.sum() / shorter(1.0)), [1.0, -2.0, 1.0])
        self._wide: list[float] = np.append(np.zeros(self._numerator.early), wide).tolist()

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        b, a = self._coefficients(xi)
        return [x.real for x in b], [x.real for x in a]

    def slopes(self, xi: list[float]) -> tuple[Array, Array]:
        # By a complex step, exact to rounding: W. Squire, G. Trapp, SIAM Review 40 (1998) 110-112.
        h = 1e-30
        rows = [self._coefficients([x + 1j * h * (i == j) for i, x in enumerate(xi)])
                for j in range(len(xi))]
        shape = len(xi), 2, len((rows[0] if rows else self.at(xi))[1])
        of_b, of_a = np.array(rows, complex).reshape(shape).imag.swapaxes(0, 1) / h
        return of_b, of_a

    def _coefficients(self, xi: Sequence[complex]) -> tuple[list[complex], list[complex]]:
        """b and a at xi; an xi beyond its limit has no further effect."""
        moved = [scale * x if abs(scale * x.real) < limit else copysign(limit, x.real)
                 for x, (scale, limit) in zip(xi, self._scales, strict=True)]
        moved = moved or [0.0] * (2 + len(self._nominal))
        integrator = [1.0, -1.0 + (moved.pop(0) if self.leaks else 0.0)] * self.integrates
        lag, width, *changes = moved
        logs = [x + y for x, y in zip(self._nominal, changes, strict=True)]
        pairs, real = changes[:2 * self._pairs:2], changes[2 * self._pairs:]
        taps = self._numerator.at((2.0 * sum(pairs) + sum(real)) / max(len(changes), 1))
        stable = denominator_of(self._pairs, *logs)
        whole, gain = max(floor(lag.real + BEFORE_WHOLE), 1 - self._delay), sum(stable) / self._gain
        b = [0j] * (self._delay + whole - 1) + [
            gain * (x + (lag - whole) * (before - x) + width * wide)
            for x, before, wide in zip_longest(taps, [0.0, *taps], self._wide, fillvalue=0.0)]
        a = multiplied(stable, self._rest, integrator or [1.0])
        while not self.count and not b[-1]:  # trim, unless the length must be the same at all xi
            b.pop()
        return b + [0j] * (len(a) - len(b)), a + [0j] * (len(b) - len(a))

    def model_at(self, xi: list[float]) -> TransferFunction:
        b, a = (np.trim_zeros(np.array(x), 'b') for x in ([0.0, *self.at(xi)[0]], self.at(xi)[1]))
        length = max(len(b), len(a))
        return TransferFunction(padded(b, length).tolist(), padded(a, length).tolist())
