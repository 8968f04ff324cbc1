"""Normalised LMS with projection: the recursion the paper describes in words (section 3.2).

With theta = (m, m c_r, m c_l) and phi = (v, -1{right}, -1{left}), u = theta' phi while a side is
engaged: the error is linear in the products, not in m, c_r, c_l themselves, so they are learned:

    theta(k+1) = theta(k) + step e W phi / (phi' W phi),   e = u - theta' phi

W = diag(1/v_max^2, 1, 1) gives the slope and the crossings regressors of one size.
f follows the gradient of J = E{(u - u_d)^2} (3.6): f(k+1) = f(k) + step_f (u - u_d) v / (1 + v^2).

Reference: S. Haykin, Adaptive Filter Theory, Prentice-Hall 1996, chapter 9 (the paper's [6]).
"""

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.input_reconstruction import (
    LEAST_SQUARE,
    InputReconstruction,
    LaggedLaw,
)
from backlash_ros.core.parameters import Parameters


class NormalisedLms(LaggedLaw):
    """LMS on (m, m c_r, m c_l) and f, fed with u reconstructed from y.

    step: 0 < step < 2. step_f: 0 keeps f. Where y moves against v nothing is learned.
    """

    RETUNED = ('lms.step', 'lms.step_f')

    def __init__(
        self, initial: Estimate, bounds: Bounds, f_bounds: tuple[float, float],
        reconstruction: InputReconstruction, step: float = 1.0, step_f: float = 0.0,
    ) -> None:
        super().__init__(initial, bounds, f_bounds, reconstruction)
        self.step, self.step_f = step, step_f
        self._v_max = 0.0

    def retune(self, p: Parameters) -> None:
        self.step, self.step_f = p.lms.step, p.lms.step_f

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        old, v = self.estimate, past.v
        if rising is None or old.status is Status.INCONSISTENT:
            return old
        m, c_r, c_l, f = old.m, old.c_r, old.c_l, old.f
        self._v_max = max(self._v_max, abs(v))
        e = u - m * (v - (c_r if rising else c_l))
        weight = 1.0 / self._v_max**2 if self._v_max**2 > LEAST_SQUARE else 0.0
        gain = self.step * e / (weight * v * v + 1.0)
        # Products first: they enter the error linearly, the crossings follow by division.
        product_r = m * c_r - gain if rising else m * c_r
        product_l = m * c_l if rising else m * c_l - gain
        if self.step_f > 0.0:
            f += self.step_f * (u - past.u_d) * v / (1.0 + v * v)
            f = min(max(f, self._f_bounds[0]), self._f_bounds[1])
        return Estimate(*self._bounds.of_products(m + gain * weight * v, product_r, product_l), f)
