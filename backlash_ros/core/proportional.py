"""The paper's structure u_d = y_m + f v, equation (3.2), with its algebraic loop solved."""

from __future__ import annotations

from math import hypot, isnan

from backlash_ros.core.backlash import Region
from backlash_ros.core.estimation.protocol import Estimate
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.structure import Command, Situation

# (m - f) divides: f beyond this share of m would multiply every error in m by more than five.
LARGEST_F_OVER_M = 0.8


# Turns of u_d smaller than this many of its standard deviations are noise of the estimates.
NOISE_BAND = 3.0
ROUNDING = 1e-12


class Proportional:
    """u_d = y_m + f v (3.2) with v = BI(u_d) (2.3): each needs the other.

    On the branch with crossing c the loop has one solution, u_d = m (y_m + f c) / (m - f).
    The branch counts when the direction of u_d agrees with it. m = f is singular: f is limited
    to 0.8 m.
    """

    delay = 0
    needs_output = False

    def control(self, situation: Situation, inverse: BacklashInverse) -> Command:
        """Return u_d and v that satisfy (3.2) and (2.3) together."""
        y_m, estimate = situation.y_m, situation.estimate
        if not isnan(estimate.std_m):
            inverse.widen_band(NOISE_BAND * _deviation(y_m, estimate))
        m, c_r, c_l = estimate.m, estimate.c_r, estimate.c_l
        f = min(estimate.f, LARGEST_F_OVER_M * m)
        right = m * (y_m + f * c_r) / (m - f)
        left = m * (y_m + f * c_l) / (m - f)
        held = y_m + f * inverse.v
        if inverse.taking_up:
            for side, u_d in ((Region.RIGHT, right), (Region.LEFT, left)):
                if inverse.side == side and inverse.direction(u_d) == Region.GAP:
                    v = inverse.step(u_d, m, c_r, c_l)  # u_d rests, v goes on to its line
                    return Command(y_m + f * v, v, f)
        elif inverse.direction(held) == Region.GAP or _rests(inverse, held):
            return Command(held, inverse.v, f)  # first case of (3.3): u_d rests, and so does v
        right_fits = inverse.direction(right) == Region.RIGHT
        left_fits = inverse.direction(left) == Region.LEFT
        if right_fits and left_fits:
            # Both directions solve the loop: the smaller move is the one a shaft would make.
            right_fits = abs(right / m + c_r - inverse.v) <= abs(left / m + c_l - inverse.v)
        if right_fits or left_fits:
            u_d = right if right_fits else left
            return Command(u_d, inverse.step(u_d, m, c_r, c_l), f)
        return Command(held, inverse.hold(held), f)


def _rests(inverse: BacklashInverse, u_d: float) -> bool:
    """Whether u_d has moved by no more than u_d on a line and y_m + f v differ in rounding."""
    return abs(u_d - inverse.extreme) <= ROUNDING * (abs(u_d) + abs(inverse.v))


def _deviation(y_m: float, estimate: Estimate) -> float:
    """Standard deviation of u_d that comes from the estimates."""
    m, c = estimate.m, estimate.c_r
    f = min(estimate.f, LARGEST_F_OVER_M * m)
    by_m = f * (y_m + f * c) / (m - f) ** 2
    by_c = m * f / (m - f)
    return hypot(by_m * estimate.std_m, by_c * max(estimate.std_c_r, estimate.std_c_l))
