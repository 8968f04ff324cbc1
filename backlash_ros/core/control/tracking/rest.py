"""What v does while the reference rests: as little as keeps y where it belongs.

Feedback through a gap that is not known to the last digit would limit-cycle. So v is held while y
is within a tolerance of the trajectory, and otherwise moves in single steps:

- to the u that holds G at rest, stopping short of it by what is uncertain about the crossing. What
  is left of u shows in y. Once it is known it is taken away by going on in the same direction,
  which crosses no gap;
- where y has left the tolerance, to a u that brings it back, and then to rest again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from math import dist, hypot, inf

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import dot
from backlash_ros.core.control.tracking.design import TrackingDesign
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.plant.backlash import Region

Array = NDArray[np.float64]

# v is held as long as |x - x*| is within so many standard deviations of the noise on y (StateModel
# scales x so that |x| is the energy of the free response of y over some 50 samples: 7 stands for
# an error of the size of the noise).
TOLERANCE = 21.0
# The same for the first samples of a rest, in which y is brought as close as the noise allows.
# Later only a drift is worth a step.
CLOSE, SETTLING = 7.0, 200
UNCERTAIN = 5.0  # the same in standard deviations of x, where that is more
SHARE = 1e-5  # the same as a share of the largest |x*| so far, where that is more
ASTRAY = 4.0  # tolerances beyond which y is not led back gently, but with full feedback
TURNS = 2  # while the trajectory rests, after which feedback goes on in single steps
ARRIVED = 0.5  # share of the tolerance within which v comes to rest after a motion
STEADY = 0.004  # share of the tolerance by which x* may still move per sample
OFF = 6.0  # standard deviations of y that mean a deviation while the state is unknown

LED_BACK = 0.25  # share of what brings y back below which it is no longer needed
TOO_WEAK = 0.5  # share of it with which y would not come back
SHORT = 2.0  # standard deviations of the crossing by which v stops short of the u at rest
GAIN = 1.5  # least factor by which a step has to lessen what u is off
MATTERS = 0.25  # share of the tolerance that it must move x by


class Mode(Enum):
    """What v does."""

    FOLLOW = auto()  # the trajectory moves, or y is far from it
    HOLD = auto()  # u is to be that at rest
    LEAD_BACK = auto()  # u is to bring y back


@dataclass
class RestState:
    """How v rests.

    u_d: where v rests. shrinkage: standard deviations by which the crossings are shrunk for it.
    largest: |x*| so far. limit: tolerance in use. rested: samples for which the trajectory has.
    turns, side: of v since then, and the newest line. near: samples since y was last away. pull:
    u - u* with which leading back began.
    """

    mode: Mode = Mode.HOLD
    u_d: float = 0.0
    side: Region = Region.GAP
    shrinkage: float = 0.0
    largest: float = 0.0
    limit: float = 0.0
    rested: int = 0
    turns: int = 0
    near: int = 0
    pull: float = 0.0


class Rest:
    """Decides whether v rests, and steps it there.

    noise_std: of y.
    """

    def __init__(self, design: TrackingDesign, noise_std: float) -> None:
        self.state = RestState()
        self._noise_std = noise_std
        self._most = inf  # largest u - u*
        self.use(design)

    def use(self, design: TrackingDesign) -> None:
        """Rest as this design says."""
        self._gain: list[float] = design.gentle.tolist()
        self._push = design.push

    def go_on_from(self, other: Rest) -> None:
        """Take over where another one of the same model rests."""
        self.state = replace(other.state)

    def decide(
        self, y: float, window: Array, x: Sequence[float], onward: Sequence[float],
        deviation: Sequence[float], x_std: float | None, side: Region, most: float,
    ) -> Mode:
        """Set the mode for this sample.

        window: r from now on. x, onward: x* now and at the next sample. deviation: x_hat - x*.
        x_std: standard deviation of x_hat, None where it is unknown. side: line in use. most: u may
        be no further than that from u*, whatever x_hat says.
        """
        state, self._most = self.state, most
        state.largest = max(state.largest, hypot(*x))
        least = SHARE * state.largest
        tolerance = max(TOLERANCE * self._noise_std, least)
        if dist(x, onward) > STEADY * tolerance or float(np.ptp(window)) > self._noise_std:
            state.mode, state.rested, state.turns = Mode.FOLLOW, 0, 0
        elif x_std is None:
            off = abs(y - window.item(0)) > OFF * self._noise_std
            state.mode = Mode.FOLLOW if off else Mode.HOLD
        else:
            state.rested += 1
            if state.rested < SETTLING:
                tolerance = max(CLOSE * self._noise_std, least)
            state.limit = max(tolerance, UNCERTAIN * x_std)
            if state.mode is Mode.FOLLOW and side is not state.side:
                state.turns += 1
            state.mode = self._mode_for(deviation)
        state.side = side
        return state.mode

    def _mode_for(self, deviation: Sequence[float]) -> Mode:
        state, size = self.state, hypot(*deviation)
        # Crossing the gap takes time. Full feedback that turns again and again overshoots by that;
        # it is due again when y has stayed where it belongs for a while, and is pushed away.
        state.near = state.near + 1 if size <= state.limit else 0
        if state.near >= SETTLING:
            state.turns = 0
        follows = state.turns < TURNS
        if size > ASTRAY * state.limit and follows:
            return Mode.FOLLOW
        if state.mode is Mode.FOLLOW and follows:
            return Mode.HOLD if size <= ARRIVED * state.limit else Mode.FOLLOW
        pull = self._pull_back(deviation)
        if state.mode is Mode.LEAD_BACK:
            # As long as it pulls the same way, and hard, or y is not yet near.
            least = LED_BACK if size <= ARRIVED * state.limit else 0.0
            if pull * state.pull > least * state.pull**2:
                return Mode.LEAD_BACK
            return Mode.HOLD
        if size <= state.limit:
            return Mode.HOLD
        state.pull = pull
        return Mode.LEAD_BACK

    def stay(self, inverse: BacklashInverse) -> None:
        """Rest where v is."""
        self.state.u_d = inverse.extreme
        self.state.shrinkage = 0.0

    def step(
        self, estimate: Estimate, ideal: float, deviation: Sequence[float],
        inverse: BacklashInverse, begins: bool,
    ) -> None:
        """Say where v is to rest, where that is better than to stay.

        ideal: u*. begins: whether the mode has changed with this sample.
        """
        state = self.state
        if begins:
            self.stay(inverse)
        if inverse.taking_up or inverse.side is Region.GAP:
            return  # still on its way, or nobody knows what u is
        engaged = estimate.c_l if inverse.side == Region.LEFT else estimate.c_r
        u = estimate.m * (inverse.v - engaged)
        if state.mode is Mode.LEAD_BACK:
            pull = self._pull_back(deviation)
            if begins or (u - ideal) * pull < TOO_WEAK * pull * pull:
                self._aim(ideal + pull, u, 0.0, inverse)
            return
        side_std = estimate.std_c_r if ideal > u else estimate.std_c_l
        away, uncertain = abs(ideal - u), SHORT * side_std * estimate.m
        if away * self._push > MATTERS * state.limit and away > GAIN * uncertain:
            self._aim(ideal, u, SHORT, inverse)

    def _pull_back(self, deviation: Sequence[float]) -> float:
        pull = -dot(self._gain, deviation)
        return min(max(pull, -self._most), self._most) if pull == pull else 0.0

    def _aim(self, u_d: float, u: float, shrinkage: float, inverse: BacklashInverse) -> None:
        self.state.u_d, self.state.shrinkage = u_d, shrinkage
        inverse.aim(u_d, Region.RIGHT if u_d > u else Region.LEFT)
