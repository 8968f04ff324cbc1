"""Control structures, which compute u_d and v from y_m: their interface, and two from papers.

u_d = y_m + f v (3.2), and the four blocks of Tao and Kokotović; the third one is in tracking/.
"""

from collections.abc import Callable
from math import hypot, inf
from typing import ClassVar, NamedTuple

import numpy as np

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Law
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region
from backlash_ros.core.plant.numerics import FourBlocks
from backlash_ros.core.plant.transfer_function import Array, StateModel

# Largest f / m: u_d has the divisor m - f, so more would amplify errors of m over fivefold.
LARGEST_F_OVER_M = 0.8
# Bounds of feedback, as multiples of the largest u that the reference has asked for so far, or of
# m (c_r - c_l) if that is larger. While the backlash is unknown: the factor by which a first guess
# may be wrong; later: enough to lead y back from where it has gone until then.
LARGEST_IN_ACQUISITION, LARGEST_FEEDBACK = 10.0, 100.0


class ControlInput(NamedTuple):
    """Inputs of a control structure at one sample."""

    y_m: float
    y: float
    estimate: Estimate
    source: Law  # provides x_hat
    limits: Limits = Limits()  # of v


class ControlStructure:
    """Computes u_d from the reference, and v from u_d by the inverse.

    The defaults are those of a structure whose gains do not depend on G.
    """

    NOT_RETUNED: ClassVar[tuple[str, ...]] = ()  # live parameters that `retune` does not take up
    delay: int = 0  # samples by which y is meant to follow y_m

    @property
    def may_change(self) -> bool:
        """Whether gains for a better G may take over at this sample."""
        return True

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> float:
        """Return the desired input u_d of G, and step the inverse to the v that produces it."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Do what the next command need not wait for; `control` does it unless this was called."""

    def redesign(self, model: StateModel) -> Callable[[], object | None] | None:
        """Return a job that designs gains for this G (None if none are safe), or None: no gains."""
        return None

    def adopt(self, gains: object, source: Law) -> None:
        """Use these gains from the next sample on, without a jump of v; source: provides x_hat."""

    def restart(self) -> None:
        """Continue after an interruption: x_hat begins anew, and y_m may have moved meanwhile."""

    def retune(self, p: Parameters, source: Law) -> bool:
        """Apply new values of live parameters from the next sample on; source: as in `adopt`.

        Returns whether gains that were designed with the old values are outdated.
        """
        return False


class Proportional(ControlStructure):
    """Solves the algebraic loop u_d = y_m + f v (3.2), v = BI(u_d) (2.3).

    On the branch with crossing c the loop has one solution, u_d = m (y_m + f c) / (m - f). The
    branch is valid if u_d moves in its direction. m = f is singular, so f is limited.
    """

    def __init__(self) -> None:
        self._estimate: Estimate | None = None  # used for the newest v

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> float:
        """Return u_d so that it and v satisfy (3.2) and (2.3) together."""
        y_m, e, band = inputs.y_m, inputs.estimate, inverse.direction_band
        m, c_r, c_l, f = e.m, e.c_r, e.c_l, min(e.f, LARGEST_F_OVER_M * e.m)
        if f == 0.0 and not inverse.taking_up and inverse.direction(y_m, band) is GAP:
            return y_m  # first case of (2.3)
        before, self._estimate = self._estimate, e
        if before is not None and before is not e and inverse.take_up < inf:
            # The inverse limits v only while u is held: it cannot tell how much of a move of u_d,
            # or of its line, is due to a new estimate.
            now, then = (_on_the_line(y_m, estimate, inverse.side) for estimate in (e, before))
            if abs(now - then) > inverse.take_up:
                inverse.slow_down()
        if f == 0.0:  # nothing to solve
            inverse.step(y_m, m, c_r, c_l)
            return y_m
        if e.learned:  # turns of u_d by less than three of its standard deviations are noise
            by_m, by_c = f * (y_m + f * c_r) / (m - f) ** 2, m * f / (m - f)
            band = max(band, 3.0 * hypot(by_m * e.std_m, by_c * max(e.std_c_r, e.std_c_l)))
        right, left = m * (y_m + f * c_r) / (m - f), m * (y_m + f * c_l) / (m - f)
        # If both branches are valid, take the smaller move, as a shaft would.
        v, held = inverse.v, y_m + f * inverse.v
        solutions = (RIGHT, right), (LEFT, left)
        if abs(right / m + c_r - v) > abs(left / m + c_l - v):
            solutions = solutions[1], solutions[0]
        if inverse.taking_up:
            for side, u_d in solutions:
                if side is inverse.side and inverse.direction(u_d, band) is GAP:
                    # u_d rests while v continues to its line.
                    return y_m + f * inverse.step(u_d, m, c_r, c_l, band)
        elif (
            abs(held - inverse.extreme) <= 1e-12 * (abs(held) + abs(v))  # up to rounding
            or inverse.direction(held, band) is GAP
        ):
            return held  # first case of (3.3): u_d rests, and so does v
        for side, u_d in solutions:
            if inverse.direction(u_d, band) is side:
                inverse.step(u_d, m, c_r, c_l, band)
                return u_d
        if abs(held) > (abs(y_m) + abs(f) * max(c_r, -c_l)) / (1.0 - LARGEST_F_OVER_M):
            # New estimates have moved both lines so far from v that no u_d could have led there.
            side, u_d = solutions[0]
            inverse.aim(u_d, side)
            return y_m + f * inverse.proceed(m, c_r, c_l)
        if band == 0.0:
            inverse.extreme = held
        return held


def _on_the_line(y_m: float, e: Estimate, side: Region) -> float:
    """Return the v that solves (3.2) on the line of this side."""
    c = e.c_r if side is RIGHT else e.c_l
    f = min(e.f, LARGEST_F_OVER_M * e.m)
    return c + (y_m + f * c) / (e.m - f)


class PolePlacement(ControlStructure):
    """Computes u_d by the four blocks (numerics.py) for the nominal G, and v = BI(u_d).

    delay: samples by which B/A_m delays a slow reference, rounded.
    """

    NOT_RETUNED = ('tracking.input_weight',)

    def __init__(self, blocks: FourBlocks) -> None:
        self._blocks = blocks
        size = len(blocks.filter) - 1
        self._companion = np.eye(size, k=-1)
        self._companion[:1] = -blocks.filter[1:]
        self._w: Array = np.zeros((2, size))  # w_1 of u_d and w_2 of y
        # The references, and the u_d that they ask for without disturbances, newest first.
        self._r: Array = np.zeros(len(blocks.demand[0]))
        self._asked: Array = np.zeros(len(blocks.demand[1]) - 1)
        self._largest_asked = 0.0  # largest |u_d| that was asked for so far
        self.delay = round(blocks.reference.group_delay)

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> float:
        """Return u_d, no further from what the references ask for than the bound of feedback."""
        blocks, e, (w_1, w_2) = self._blocks, inputs.estimate, self._w
        u_d = float(blocks.theta_1 @ w_1 + blocks.theta_2 @ w_2)
        u_d += blocks.theta_20 * inputs.y + blocks.theta_3 * inputs.y_m
        numerator, denominator = blocks.demand
        self._r = np.append(inputs.y_m, self._r[:-1])
        asked = float(numerator @ self._r - denominator[1:] @ self._asked)
        self._asked = np.append(asked, self._asked)[:-1]
        self._largest_asked = max(self._largest_asked, abs(asked))
        share = LARGEST_FEEDBACK if e.status is Status.TRACKING else LARGEST_IN_ACQUISITION
        reach = share * max(self._largest_asked, e.m * (e.c_r - e.c_l))
        u_d = min(max(u_d, asked - reach), asked + reach)
        inverse.step(u_d, e.m, e.c_r, e.c_l)
        self._w = np.array([self._companion @ w_1, self._companion @ w_2])
        self._w[:, :1] += [[u_d], [inputs.y]]
        return u_d
