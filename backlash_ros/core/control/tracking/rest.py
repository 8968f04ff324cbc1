"""What v does while the reference rests: as little as keeps y where it belongs.

Feedback through a gap that is not known to the last digit would limit-cycle. So v is held while y
is within a tolerance of the trajectory, and otherwise moves in single steps. Full feedback brings
back all that is off; what is less it would leave to itself, as noise, until it is far away.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto
from math import hypot

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.plant.backlash import Region

# v is held as long as |x - x*|, the energy of the free response of y over some 50 samples, is
# within so many standard deviations of the noise on y: 7 stands for an error of its size.
TOLERANCE = 21.0
# The same for the first samples of a rest; later only a drift is worth a step.
CLOSE, SETTLING = 7.0, 200
UNCERTAIN = 5.0  # the same in standard deviations of x, where that is more
# How often y may be brought back by full feedback, and gently until the tolerance is doubled each
# time, before it has rested for SETTLING samples.
MOST_RETURNS = 2
ASTRAY = 4.0  # tolerances beyond which y is not led back gently, but with full feedback
ARRIVED = 0.5  # share of the tolerance within which v comes to rest after that
OFF = 6.0  # standard deviations of y that mean a deviation while the state is unknown
SHORT = 2.0  # standard deviations of the crossing by which v stops short of the u at rest


class Mode(Enum):
    """What v does."""

    FOLLOW = auto()  # the trajectory moves
    RETURN = auto()  # y is far away: full feedback brings it back
    # To the u that holds G at rest, short of it by what is uncertain about the crossing. What is
    # left of u shows in y; once it is known v goes on in the same direction, which crosses no gap.
    HOLD = auto()
    LEAD_BACK = auto()  # to a u that brings y back into the tolerance, then to rest again

    @property
    def steps(self) -> bool:
        """Whether v moves in single steps only."""
        return self in (Mode.HOLD, Mode.LEAD_BACK)


@dataclass
class Rest:
    """Decides whether v rests, and steps it there."""

    mode: Mode = Mode.HOLD
    target: tuple[float, float] = (0.0, 0.0)  # u_d where v rests, deviations to shrink its crossing
    side: Region = Region.GAP  # newest line
    largest: float = 0.0  # |x*| so far
    limit: float = 0.0  # tolerance in use
    rested: int = 0  # samples for which the trajectory has
    returns: int = 0  # how often y was brought back since by full feedback
    leads: int = 0  # and gently
    turns: int = 0  # of v in this return
    near: int = 0  # samples since y was last away
    pull: float = 0.0  # u - u* with which leading back began

    def decide(
        self, y: float, noise_std: float, plan: IdealTrajectory, deviation: Sequence[float],
        x_std: float | None, side: Region, pull: float, acts: bool,
    ) -> Mode:
        """Set the mode for this sample.

        x_std: of x_hat, None where it is unknown. side: line in use. pull: u - u* that brings y
        back gently. acts: whether feedback asks for more than noise.
        """
        self.largest = max(self.largest, hypot(*plan.x))
        least = 1e-5 * self.largest  # tolerance, where that is more
        still = 0.004 * max(TOLERANCE * noise_std, least)  # by which x* may move per sample
        if plan.spread > noise_std or (self.mode is Mode.FOLLOW and plan.moved > still):
            self.mode, self.rested, self.returns, self.leads = Mode.FOLLOW, 0, 0, 0
        elif x_std is None:
            off = abs(y - plan.references.window.item(0)) > OFF * noise_std
            self.mode = Mode.RETURN if off else Mode.HOLD
        else:
            self.rested += 1
            width = CLOSE if self.rested < SETTLING else TOLERANCE
            # Where y left again each time, the constants do not tell how to come closer.
            width *= 2.0 ** min(max(self.leads - MOST_RETURNS, 0), 10)
            self.limit = max(width * noise_std, least, UNCERTAIN * x_std)
            if self.mode is Mode.RETURN and side is not self.side:
                self.turns += 1
            self.mode = self._mode_at_rest(hypot(*deviation), len(plan.x), pull, acts)
        self.side = side
        return self.mode

    def _mode_at_rest(self, size: float, order: int, pull: float, acts: bool) -> Mode:
        # Crossing the gap takes time. Full feedback that turns again and again overshoots by that;
        # it is due again when y has stayed where it belongs for a while, and is pushed away.
        self.near = self.near + 1 if size <= self.limit else 0
        if self.near >= SETTLING:
            self.returns = self.leads = 0
        returns = self.mode is Mode.RETURN
        if self.turns <= order if returns else self.returns < MOST_RETURNS:
            goes_on = not self.mode.steps and acts and size > ARRIVED * self.limit
            if goes_on or size > ASTRAY * self.limit:
                if not returns:
                    self.turns, self.returns = 0, self.returns + 1
                return Mode.RETURN
        if self.mode is Mode.LEAD_BACK:
            # As long as it pulls the same way, and a quarter as hard, or y is not yet near.
            least = 0.25 if size <= ARRIVED * self.limit else 0.0
            return Mode.LEAD_BACK if pull * self.pull > least * self.pull**2 else Mode.HOLD
        if size <= self.limit:
            return Mode.HOLD
        self.pull, self.leads = pull, self.leads + 1
        return Mode.LEAD_BACK

    def stay(self, inverse: BacklashInverse) -> None:
        """Rest where v is."""
        self.target = inverse.extreme, 0.0

    def step(
        self, estimate: Estimate, plan: IdealTrajectory, pull: float, inverse: BacklashInverse,
        begins: bool,
    ) -> None:
        """Aim v at where it is to rest, where that is better than to stay."""
        if begins:
            self.stay(inverse)
        if inverse.taking_up or inverse.side is Region.GAP:
            return  # still on its way, or nobody knows what u is
        ideal = plan.u
        engaged = estimate.c_l if inverse.side is Region.LEFT else estimate.c_r
        u = estimate.m * (inverse.v - engaged)
        if self.mode is Mode.LEAD_BACK:
            if not begins and (u - ideal) * pull >= 0.5 * pull * pull:
                return  # strong enough to bring y back
            u_d, shrinkage = ideal + pull, 0.0
        else:
            side_std = estimate.std_c_r if ideal > u else estimate.std_c_l
            away, uncertain = abs(ideal - u), SHORT * side_std * estimate.m
            # A step has to move x by a share of the tolerance, and to lessen what u is off.
            if not (away * plan.design.push > 0.25 * self.limit
                    and away > max(1.5 * uncertain, plan.noise_band)):
                return
            u_d, shrinkage = ideal, SHORT
        self.target = u_d, shrinkage
        inverse.aim(u_d, Region.RIGHT if u_d > u else Region.LEFT)
