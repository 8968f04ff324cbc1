"""The paper's structure u_d = y_m + f v, equation (3.2), with its algebraic loop solved."""

from __future__ import annotations

from math import hypot, inf

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import Command, ControlInput, ControlStructure
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.plant.backlash import Region

# (m - f) divides: f beyond this share of m would multiply every error in m by more than five.
LARGEST_F_OVER_M = 0.8


class Proportional(ControlStructure):
    """u_d = y_m + f v (3.2) with v = BI(u_d) (2.3): each needs the other.

    On the branch with crossing c the loop has one solution, u_d = m (y_m + f c) / (m - f).
    The branch counts when the direction of u_d agrees with it. m = f is singular: f is limited
    to 0.8 m.
    """

    def __init__(self) -> None:
        self._estimate: Estimate | None = None  # that v was made with

    def go_on_from(self, other: ControlStructure, state_known: bool = True) -> None:
        """Take over what the present v was made with."""
        if isinstance(other, Proportional):
            self._estimate = other._estimate

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return u_d and v that satisfy (3.2) and (2.3) together."""
        y_m, e, band = inputs.y_m, inputs.estimate, inverse.direction_band
        m, c_r, c_l, f = e.m, e.c_r, e.c_l, min(e.f, LARGEST_F_OVER_M * e.m)
        if f == 0.0 and not inverse.taking_up and inverse.direction(y_m, band) is Region.GAP:
            return Command(y_m, inverse.v, f)  # first case of (2.3)
        before, self._estimate = self._estimate, e
        if before is not None and before is not e and inverse.take_up < inf:
            # The inverse is slow only as far as u does not move: it cannot tell what u_d, or the
            # line that it lies on, owe to a new estimate.
            now, then = (_on_the_line(y_m, estimate, inverse.side) for estimate in (e, before))
            if abs(now - then) > inverse.take_up:
                inverse.slow_down()
        if f == 0.0:  # nothing to solve
            return Command(y_m, inverse.step(y_m, m, c_r, c_l), f)
        if e.learned:  # turns of u_d by less than three of its standard deviations are noise
            by_m = f * (y_m + f * c_r) / (m - f) ** 2
            by_c = m * f / (m - f)
            band = max(band, 3.0 * hypot(by_m * e.std_m, by_c * max(e.std_c_r, e.std_c_l)))
        right, left = m * (y_m + f * c_r) / (m - f), m * (y_m + f * c_l) / (m - f)
        # Where both directions solve the loop, the smaller move is the one a shaft would make.
        v, held = inverse.v, y_m + f * inverse.v
        solutions = (Region.RIGHT, right), (Region.LEFT, left)
        if abs(right / m + c_r - v) > abs(left / m + c_l - v):
            solutions = solutions[1], solutions[0]
        if inverse.taking_up:
            for side, u_d in solutions:
                if side is inverse.side and inverse.direction(u_d, band) is Region.GAP:
                    v = inverse.step(u_d, m, c_r, c_l, band)  # u_d rests, v goes on to its line
                    return Command(y_m + f * v, v, f)
        elif (
            abs(held - inverse.extreme) <= 1e-12 * (abs(held) + abs(v))  # but for rounding
            or inverse.direction(held, band) is Region.GAP
        ):
            return Command(held, v, f)  # first case of (3.3): u_d rests, and so does v
        for side, u_d in solutions:
            if inverse.direction(u_d, band) is side:
                return Command(u_d, inverse.step(u_d, m, c_r, c_l, band), f)
        if abs(held) > (abs(y_m) + abs(f) * max(c_r, -c_l)) / (1.0 - LARGEST_F_OVER_M):
            # New estimates have moved both lines so far from v that no u_d could have led there.
            side, u_d = solutions[0]
            inverse.aim(u_d, side)
            v = inverse.proceed(m, c_r, c_l)
            return Command(y_m + f * v, v, f)
        if band == 0.0:
            inverse.extreme = held
        return Command(held, v, f)


def _on_the_line(y_m: float, e: Estimate, side: Region) -> float:
    """v on the line of a side."""
    c = e.c_r if side is Region.RIGHT else e.c_l
    return c + (y_m + e.f * c) / (e.m - min(e.f, LARGEST_F_OVER_M * e.m))
