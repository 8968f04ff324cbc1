"""Feedback that holds x on the ideal trajectory: K (x_hat - x*) + K_q (q - q*), within bounds.

A deviation that noise explains is left alone. What is beyond is fed back as hard as the estimate of
the backlash is trusted: the first one may be confidently wrong, which the samples after it
contradict. So feedback hardens as it holds, and softens while v does not follow.

While the reference rests v does as little as keeps y where it belongs: feedback through a gap that
is not known to the last digit would limit-cycle. So v is held while y is within a tolerance of the
trajectory, and otherwise moves in single steps. Full feedback brings back all that is off; what is
less it would leave to itself, as noise, until it is far away.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from math import hypot, inf, isnan, nan

import numpy as np

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import LARGEST_FEEDBACK, LARGEST_IN_ACQUISITION
from backlash_ros.core.control.tracking.design import SOFTEST, TrackingDesign, dot
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region
from backlash_ros.core.plant.transfer_function import Array

TRUSTED_AFTER = 40  # samples for which an estimate has to hold before it gets full feedback
# An estimate this sharp, in relative deviations of slope and gap, counts so many times per sample.
SHARP, SHARP_COUNTS = 0.01, 17
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


@dataclass
class Trust:
    """What was made of the estimates so far."""

    known: bool = False  # whether the newest comes from data of this loop
    slope: float = nan  # that is inverted
    crossings: tuple[float, float] = (0.0, 0.0)  # that are inverted, shrunk by their uncertainty
    held_for: int = 0  # samples for which estimates have held, sharp ones count more often
    in_use_for: int = 0  # samples since there is one
    sharp_counts: int = SHARP_COUNTS

    @property
    def full(self) -> bool:
        return self.held_for >= TRUSTED_AFTER


@dataclass
class FeedbackState:
    """What feedback remembers."""

    integral: float = 0.0  # q - q*
    level: int = 0  # place in the schedule while v does not follow
    free: int = 0  # samples since it does again
    bounded: bool = False  # whether feedback met its bound the sample before
    width: float = 1.0  # bound in scales while the backlash is unknown
    asked: float = 0.0  # largest |u*| so far
    blind_for: int = 1  # samples from now on in which x_hat cannot be known


@dataclass
class DeviationNoise:
    """How much of x_hat - x* may be noise: of y, of x_hat, and of the references that make x*."""

    u_std: list[float]  # of K (x_hat - x*) for each gain, at least K times half the noise of y
    x_std: float = 0.0  # of |x_hat|
    x_known: bool = False  # whether the covariance of x_hat is
    ignored: float = 0.0  # |x_hat - x*| that is left alone
    tolerated: float = 0.0  # |x_hat - x*| that is worth no crossing


class StateFeedback:
    """Gains of a design, used as far as the estimate is trusted; shrinkage: see Tracking.

    While nothing is known the acquisition gain replaces K, and the trajectory excites the backlash.
    """

    def __init__(self, design: TrackingDesign, shrinkage: float, noise_std: float) -> None:
        self.trust, self.state = Trust(), FeedbackState()
        self.shrinkage, self.y_std = shrinkage, noise_std
        self._newest: Estimate | None = None
        self.gap_u = 0.0  # that the gap takes
        self.use(design)

    def use(self, design: TrackingDesign) -> None:
        """Use these gains."""
        self._design = design
        self._least = 0.5 * self.y_std * np.array([hypot(*gain) for gain in design.schedule])
        self.noise = DeviationNoise(self._least.tolist())
        # Places in the schedule: of the gain that its noise asks for, and of the one in use.
        self._quiet = self._in_use = 0

    def restart(self) -> None:
        """Go on from the softest, as x_hat begins anew, full of noise."""
        self.trust, self._newest = Trust(sharp_counts=1), None
        self.state = replace(self.state, width=1.0, asked=0.0, bounded=False,
                             blind_for=self._design.model.order)

    def take(self, estimate: Estimate, ideal: float, first: bool) -> bool:
        """Take in estimate and u* of this sample; returns whether the estimate is another one."""
        trust, status, gap = self.trust, estimate.status, estimate.c_r - estimate.c_l
        another, self._newest = estimate is not self._newest, estimate
        if another:
            # What was learned before a restart says nothing yet about the state of G. A law without
            # deviations says by its status alone that it has learned, and holds that later.
            trust.known = status not in (Status.ACQUIRING, Status.INCONSISTENT) and (
                trust.known or estimate.learned or status is Status.TRACKING)
            trust.crossings = shrunk_crossings(estimate, self.shrinkage, trust.known)
            # On the way to its first agreement with the data the m of such a law may be anywhere.
            if isnan(trust.slope) or estimate.learned or status is Status.TRACKING:
                trust.slope = estimate.m
        self.state.asked, self.gap_u = max(self.state.asked, abs(ideal)), estimate.m * gap
        if not (trust.known and estimate.learned):
            # Without deviations nobody knows how far it may be relied on.
            trust.held_for = trust.in_use_for = 0
            return another
        trust.in_use_for += 1
        if first:  # of this loop: it was known before
            trust.held_for = TRUSTED_AFTER
        elif not trust.full:
            # Beside far larger u even a gap that is hardly known makes little difference.
            large = max(gap, self.state.width * max(self.state.asked, self.gap_u) / estimate.m)
            sharp = (estimate.std_m < SHARP * estimate.m
                     and estimate.std_c_r + estimate.std_c_l < SHARP * large)
            trust.held_for += trust.sharp_counts if sharp else 1
        return another

    def prepare(
        self, x_cov: Array | None, y_std: float, x_noise: Array, reference_std: float,
    ) -> None:
        """Choose the gain that noise allows; x_noise: covariance of x* for noise of 1 in r."""
        noise, deviation_std = self.noise, 0.0
        noise.x_known = x_cov is not None
        if x_cov is not None:
            of_x_hat = self._design.variances(x_cov)
            of_both = of_x_hat + reference_std**2 * self._design.variances(x_noise)
            stds = np.sqrt(np.maximum(of_both, 0.0))
            noise.x_std = max(of_x_hat.item(-1), 0.0)**0.5
            noise.u_std, deviation_std = np.maximum(stds[:-1], self._least).tolist(), stds.item(-1)
        # By as much v may rest off: one rule for motion and rest.
        noise.ignored = ARRIVED * max(CLOSE * y_std, UNCERTAIN * noise.x_std)
        # What noise of the references moves and v did not follow shows as a deviation as well.
        noise.tolerated = max(noise.ignored, ARRIVED * UNCERTAIN * deviation_std)
        # As hard as leaves what feedback makes of noise below a tenth of the u that the gap takes.
        most = 0.1 * self.gap_u or inf
        self._quiet = next((i for i, std in enumerate(noise.u_std) if std <= most),
                           len(noise.u_std) - 1)

    def deviation(self, x_hat: Sequence[float] | Array, x: Sequence[float]) -> list[float]:
        """x_hat - x*; 0 while x_hat cannot be known."""
        if self.state.blind_for:
            self.state.blind_for -= 1
            return [0.0] * len(x)
        return [float(x_hat[i]) - each for i, each in enumerate(x)]

    def u(self, error: Sequence[float], held_back: bool, largest: float) -> tuple[float, float]:
        """What is taken from u* for an error of x, and what of it is worth a crossing of the gap.

        held_back: whether v met its limits, or is on its way across the gap. largest: |x*| so far.
        """
        # Per sample, of the bound while the backlash is unknown; samples without a limit after
        # which feedback takes a step back to full.
        widening, stiffen_after = 1.03, 20
        state, trust, most, noise = self.state, self.trust, self.bounds[0], self.noise
        if trust.held_for:
            off = hypot(*error)
            if held_back or state.bounded:
                state.free, state.level = 0, min(state.level + 1, SOFTEST)
            else:
                state.free += 1
                if state.level > 0 and state.free % stiffen_after == 0:
                    state.level -= 1
            # K, or the less of it the longer v does not follow, and the newer the estimate. Far
            # away, beyond what x* has been and noise explains, it does not matter what noise does.
            astray = off > max(largest, ASTRAY / ARRIVED * noise.ignored)
            unproven = SOFTEST - trust.held_for * (SOFTEST + 1) // TRUSTED_AFTER
            self._in_use = max(state.level, unproven, 0 if astray else self._quiet)
            feedback = worth = dot(self._design.schedule[self._in_use], error)
            if self.knows_noise:
                feedback *= 1.0 - noise.ignored / max(off, noise.ignored)
                worth *= 1.0 - noise.tolerated / max(off, noise.tolerated)
        else:
            feedback = worth = dot(self._design.acquisition or (), error)
            if not -most < feedback < most:
                # A gap wider than the first guess has to be crossed some day.
                state.width = min(widening * state.width, LARGEST_IN_ACQUISITION)
        if trust.full:
            by_integral = self._design.feedback.integral * state.integral
            feedback, worth = feedback + by_integral, worth + by_integral
        state.bounded = trust.held_for > 0 and not -most <= feedback <= most
        if isnan(feedback):
            return 0.0, 0.0
        return min(max(feedback, -most), most), min(max(worth, -most), most)

    def pull_back(self, deviation: Sequence[float]) -> float:
        """u - u* that brings y back gently."""
        pull, most = -dot(self._design.gentle, deviation), self.bounds[0]
        return 0.0 if isnan(pull) else min(max(pull, -most), most)

    def furthest(
        self, deviation: Sequence[float], ahead: Sequence[float], side: Region, turns_in: int,
    ) -> float:
        """The furthest u that v can hold and never be asked to come back from until u* turns."""
        by_state, by_u = self._design.holding[self._in_use]
        agreed = side * (by_state @ deviation + by_u @ ahead)[:turns_in]
        return side * float(agreed.min(initial=inf))

    def integrate(self, difference: float, limited: bool) -> None:
        """Take in y* - y; a saturated actuator cannot follow: going on would only wind up."""
        if not self.trust.full:
            self.state.integral = 0.0
        elif not (limited or self.state.bounded):
            self.state.integral += difference

    @property
    def knows_noise(self) -> bool:
        """Whether full feedback can tell a deviation from noise."""
        return self.trust.full and self.noise.x_known

    @property
    def noise_u(self) -> float:
        """Standard deviation of what feedback makes of noise."""
        return self.noise.u_std[self._quiet]

    @property
    def bounds(self) -> tuple[float, float]:
        """Largest feedback, and largest |u_d - u*| whatever makes u_d."""
        scale = max(self.state.asked, self.gap_u)
        if not self.trust.held_for:
            # A wrong slope may make the loop unstable, which bounded feedback slows down.
            return self.state.width * scale, LARGEST_IN_ACQUISITION * scale
        # No error of y that would not matter at rest calls for too much; |K| is what it calls for.
        by_noise = TOLERANCE * self.y_std * hypot(*self._design.schedule[0])
        most = LARGEST_FEEDBACK * max(scale, by_noise)
        return most, most


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
    side: Region = GAP  # newest line
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
        x_std: float | None, side: Region, pull_back: Callable[[Sequence[float]], float],
        acts: bool,
    ) -> Mode:
        """Set the mode for this sample.

        x_std: of x_hat, None where it is unknown. side: line in use. pull_back: u - u* that brings
        y back gently. acts: whether feedback asks for more than noise.
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
            size, pull = hypot(*deviation), pull_back(deviation)
            self.mode = self._mode_at_rest(size, len(plan.x), pull, acts)
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

    def step(
        self, estimate: Estimate, plan: IdealTrajectory, pull: float, inverse: BacklashInverse,
        begins: bool,
    ) -> None:
        """Aim v at where it is to rest, where that is better than to stay."""
        if inverse.taking_up or inverse.side is GAP:
            return  # still on its way, or nobody knows what u is
        ideal, engaged = plan.u, estimate.c_l if inverse.side is LEFT else estimate.c_r
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
        inverse.aim(u_d, RIGHT if u_d > u else LEFT)


def shrunk_crossings(estimate: Estimate, deviations: float, known: bool) -> tuple[float, float]:
    """Crossings shrunk towards each other by their uncertainty; both 0 while nothing is known.

    Over-compensation drives past the gap and starts a limit cycle, under-compensation only leaves
    a rest of the backlash: in a loop around y the smaller gap is the safe one.
    """
    if deviations == 0.0:
        return estimate.c_r, estimate.c_l
    if isnan(estimate.std_c_r):  # a law that knows no uncertainty
        return (estimate.c_r, estimate.c_l) if known else (0.0, 0.0)
    middle = 0.5 * (estimate.c_r + estimate.c_l)
    return (max(estimate.c_r - deviations * estimate.std_c_r, middle),
            min(estimate.c_l + deviations * estimate.std_c_l, middle))
