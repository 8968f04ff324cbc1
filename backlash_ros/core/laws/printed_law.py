"""The update law exactly as printed, equation (3.11), with guards, as a reference.

All four quotients reduce to the one equation e = u - u_d = 0, solved for one unknown at a time:

    f   = m (u - y_m) / (u + m w)         m   = u f / (u - y_m - f w)
    c   = (u - y_m) / f - u / m           (c_r and c_l alike)

One equation cannot identify four unknowns; docs/paper.md says what follows. Use `lms` to learn.
"""

from math import isfinite, nan

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.input_reconstruction import LaggedLaw


def printed_f(u: float, y_m: float, m: float, w: float) -> float:
    """f = F_n / F_d of (3.11); nan where F_d is 0."""
    numerator = u * y_m * m**2 + u * w * m**3 - y_m**2 * m**2 - y_m * m**3 * w
    denominator = u * y_m * m + y_m * w * m**2 + w**2 * m**3 + u * w * m**2
    return numerator / denominator if denominator != 0.0 else nan


def printed_m(u: float, y_m: float, f: float, w: float) -> float:
    """m = M_n / M_d of (3.11); nan where M_d is 0."""
    numerator = u * y_m * f**2 + u * f**3 * w
    denominator = u * y_m * f + u * f**2 * w - y_m**2 * f - 2.0 * y_m * f**2 * w - f**3 * w**2
    return numerator / denominator if denominator != 0.0 else nan


def printed_c(u: float, y_m: float, f: float, m: float) -> float:
    """c_r = C_1n / C_1d and c_l = C_2n / C_2d of (3.11), which are alike; nan where C_1d is 0."""
    numerator = u * f * m**2 - u * f**2 * m - y_m * m**2 * f
    denominator = f**2 * m**2
    return numerator / denominator if denominator != 0.0 else nan


class PrintedLaw(LaggedLaw):
    """Equations (3.11), evaluated in the printed order with the newest values.

    Guards: a quotient that is not finite is skipped, the rest is projected into the bounds.
    """

    skipped, _upward, _u_before = 0, True, 0.0

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        old = self.estimate
        # w is c_r in the upward region, c_l in the downward one, and kept in the gap.
        if u != self._u_before:
            self._upward = u > self._u_before
        upward, self._u_before = self._upward, u
        w = old.c_r if upward else old.c_l
        f = self._guarded(printed_f(u, past.y_m, old.m, w), old.f, self._f_bounds)
        m = self._guarded(printed_m(u, past.y_m, f, w), old.m, self._bounds.m)
        c = printed_c(u, past.y_m, f, m)
        c_r = self._guarded(c, old.c_r, self._bounds.c_r) if upward else old.c_r
        c_l = old.c_l if upward else self._guarded(c, old.c_l, self._bounds.c_l)
        return Estimate(m, c_r, c_l, f, status=old.status)

    def _guarded(self, value: float, old: float, bounds: tuple[float, float]) -> float:
        if not isfinite(value):
            self.skipped += 1
            return old
        return min(max(value, bounds[0]), bounds[1])
