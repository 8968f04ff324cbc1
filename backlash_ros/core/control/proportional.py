"""The paper's structure u_d = y_m + f v, equation (3.2), with its algebraic loop solved."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf, isnan

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import Command, ControlInput, Structure
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import StateSource
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.state_model import StateModel

# (m - f) divides: f beyond this share of m would multiply every error in m by more than five.
LARGEST_F_OVER_M = 0.8


# Turns of u_d smaller than this many of its standard deviations are noise of the estimates.
NOISE_BAND = 3.0
ROUNDING = 1e-12  # relative difference of two v that are one but for rounding


class Proportional:
    """u_d = y_m + f v (3.2) with v = BI(u_d) (2.3): each needs the other.

    On the branch with crossing c the loop has one solution, u_d = m (y_m + f c) / (m - f).
    The branch counts when the direction of u_d agrees with it. m = f is singular: f is limited
    to 0.8 m.
    """

    delay = 0

    def __init__(self) -> None:
        self._estimate: Estimate | None = None  # that v was made with

    def go_on_from(self, other: Structure, state_known: bool = True) -> None:
        """Take over what the present v was made with."""
        if isinstance(other, Proportional):
            self._estimate = other._estimate

    @property
    def may_change(self) -> bool:
        """Nothing here changes with G."""
        return True

    def redesign(self, model: StateModel) -> Callable[[], object | None]:
        """Nothing here depends on G: any model will do."""
        return object

    def adopt(self, gains: object, source: StateSource) -> None:
        """Nothing changes."""

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return u_d and v that satisfy (3.2) and (2.3) together."""
        y_m, estimate = inputs.y_m, inputs.estimate
        m, c_r, c_l, f = estimate.m, estimate.c_r, estimate.c_l, estimate.f
        if f == 0.0 and not inverse.taking_up and inverse.direction(y_m) is Region.GAP:
            return Command(y_m, inverse.v, f)  # first case of (2.3)
        before, self._estimate = self._estimate, estimate
        if before is not None and before is not estimate and inverse.take_up < inf:
            # The inverse is slow only as far as u does not move: it cannot tell what u_d, or the
            # line that it lies on, owe to a new estimate.
            now, then = _solution(y_m, estimate, inverse), _solution(y_m, before, inverse)
            if abs(now - then) > inverse.take_up:
                inverse.slow_down()
        if f == 0.0:  # nothing to solve
            return Command(y_m, inverse.step(y_m, m, c_r, c_l), f)
        if f > LARGEST_F_OVER_M * m:
            f = LARGEST_F_OVER_M * m
        right = m * (y_m + f * c_r) / (m - f)
        left = m * (y_m + f * c_l) / (m - f)
        v = inverse.v
        nearer_right = abs(right / m + c_r - v) <= abs(left / m + c_l - v)
        held = y_m + f * v
        rests = abs(held - inverse.extreme) <= ROUNDING * (abs(held) + abs(v))
        if not (rests or inverse.taking_up):
            # Going on along the line in use, by far the most frequent case, needs no band.
            side = inverse.side
            u_d = right if nearer_right else left
            if (
                side is (Region.RIGHT if nearer_right else Region.LEFT)
                and (held - inverse.extreme) * side > 0.0
                and (u_d - inverse.extreme) * side > 0.0
            ):
                return Command(u_d, inverse.step(u_d, m, c_r, c_l), f)
        if not isnan(estimate.std_m):
            inverse.widen_band(NOISE_BAND * _deviation(y_m, f, estimate))
        if inverse.taking_up:
            for side, u_d in ((Region.RIGHT, right), (Region.LEFT, left)):
                if inverse.side is side and inverse.direction(u_d) is Region.GAP:
                    v = inverse.step(u_d, m, c_r, c_l)  # u_d rests, v goes on to its line
                    return Command(y_m + f * v, v, f)
        elif rests or inverse.direction(held) is Region.GAP:
            return Command(held, v, f)  # first case of (3.3): u_d rests, and so does v
        right_fits = inverse.direction(right) is Region.RIGHT
        left_fits = inverse.direction(left) is Region.LEFT
        if right_fits and left_fits:
            # Both directions solve the loop: the smaller move is the one a shaft would make.
            right_fits = nearer_right
        if right_fits or left_fits:
            u_d = right if right_fits else left
            return Command(u_d, inverse.step(u_d, m, c_r, c_l), f)
        if abs(held) > (abs(y_m) + abs(f) * max(c_r, -c_l)) / (1.0 - LARGEST_F_OVER_M):
            # New estimates have moved both lines so far from v that no u_d could have led there.
            nearest = (Region.RIGHT, right) if nearer_right else (Region.LEFT, left)
            inverse.aim(nearest[1], nearest[0])
            v = inverse.step(nearest[1], m, c_r, c_l)
            return Command(y_m + f * v, v, f)
        return Command(held, inverse.hold(held), f)


def _solution(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> float:
    """v on the line in use."""
    m, c = estimate.m, estimate.c_r if inverse.side is Region.RIGHT else estimate.c_l
    return c + (y_m + estimate.f * c) / (m - min(estimate.f, LARGEST_F_OVER_M * m))


def _deviation(y_m: float, f: float, estimate: Estimate) -> float:
    """Standard deviation of u_d that comes from the estimates."""
    m = estimate.m
    by_m = f * (y_m + f * estimate.c_r) / (m - f) ** 2
    by_c = m * f / (m - f)
    return hypot(by_m * estimate.std_m, by_c * max(estimate.std_c_r, estimate.std_c_l))
