"""Feedback that holds x on the ideal trajectory: K (x_hat - x*) + K_q (q - q*), within bounds.

A deviation that noise explains is ignored. The gain for a larger one depends on how far the
estimate of the backlash is trusted, as a first estimate may be confidently wrong until the next
samples contradict it: the gain rises while the estimate holds, and falls while v does not follow.

While the reference rests, continuous feedback through a gap that is not known exactly would
limit-cycle. So v is held while y is within a tolerance of the trajectory, and otherwise moves in
single steps. Full feedback is only for y far away: smaller deviations it would ignore as noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from math import hypot, inf, isnan, nan

import numpy as np

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import LARGEST_FEEDBACK, LARGEST_IN_ACQUISITION
from backlash_ros.core.control.tracking.design import SOFTEST, TrackingDesign, variances
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region
from backlash_ros.core.plant.numerics import dot
from backlash_ros.core.plant.transfer_function import Array

TRUSTED_AFTER = 40  # samples for which an estimate has to hold before it gets full feedback
# A sample with relative standard deviations of slope and gap below SHARP counts as so many.
SHARP, SHARP_COUNTS = 0.01, 17
# v is held while |x - x*|, the root of the energy of the free response of y over some 50 samples,
# is below so many standard deviations of the noise on y; a constant error y of one of them gives 7.
TOLERANCE = 21.0
# The same for the first SETTLING samples of a rest; later only a drift is worth a step.
CLOSE, SETTLING = 7.0, 200
UNCERTAIN = 5.0  # least tolerance, in standard deviations of x_hat
# How often full feedback may bring y back, and how often gentle steps may before each of them
# doubles the tolerance, until y has stayed within it for SETTLING samples.
MOST_RETURNS = 2
ASTRAY = 4.0  # tolerances beyond which full feedback brings y back, instead of gentle steps
ARRIVED = 0.5  # fraction of the tolerance within which v comes to rest after that
OFF = 6.0  # standard deviations of y that count as a deviation while x_hat is unknown
SHORT = 2.0  # standard deviations of the crossing by which v stops short of the u at rest


@dataclass
class Trust:
    """How far the estimates are trusted, and the slope and crossings that are inverted."""

    known: bool = False  # whether the newest estimate was learned, and holds
    slope: float = nan  # in use by the inverse
    crossings: tuple[float, float] = (0.0, 0.0)  # the same, shrunk by their uncertainty
    held_for: int = 0  # samples for which estimates have held; a sharp one counts several times
    in_use_for: int = 0  # samples since estimates are known
    sharp_counts: int = SHARP_COUNTS  # how often a sharp one counts

    @property
    def full(self) -> bool:
        return self.held_for >= TRUSTED_AFTER


@dataclass
class FeedbackState:
    """State of the feedback, from sample to sample."""

    integral: float = 0.0  # q - q*
    level: int = 0  # index into the schedule, which rises while v does not follow
    free: int = 0  # samples since v follows again
    bounded: bool = False  # whether feedback met its bound at the sample before
    width: float = 1.0  # bound while the backlash is unknown, in multiples of its scale
    asked: float = 0.0  # largest |u*| so far
    blind_for: int = 1  # coming samples in which x_hat cannot be known yet


@dataclass
class DeviationNoise:
    """How much of x_hat - x* noise explains: of y, of x_hat, and of the references behind x*."""

    u_std: list[float]  # of K (x_hat - x*) for each gain, at least |K| times half the noise of y
    x_std: float = 0.0  # of |x_hat|
    x_known: bool = False  # whether the covariance of x_hat is known
    ignored: float = 0.0  # |x_hat - x*| that is not fed back
    tolerated: float = 0.0  # |x_hat - x*| that is not worth a crossing of the gap


class StateFeedback:
    """State feedback, as hard as the estimate can be trusted; shrinkage: see Tracking.

    Until an estimate is known, the acquisition gain replaces K, and the trajectory excites the gap.
    """

    def __init__(self, design: TrackingDesign, shrinkage: float, noise_std: float) -> None:
        self.trust, self.state = Trust(), FeedbackState()
        self.shrinkage, self.y_std = shrinkage, noise_std
        self._newest: Estimate | None = None
        self.gap_u = 0.0  # m (c_r - c_l)
        self.use(design)

    def use(self, design: TrackingDesign) -> None:
        """Use the gains of this design."""
        self._design = design
        self._x_cov: Array | None = None  # the newest one, and its `variances`
        self._of_x_hat: Array = np.zeros(len(design.schedule) + 1)
        self._least = 0.5 * self.y_std * np.array([hypot(*gain) for gain in design.schedule])
        self.noise = DeviationNoise(self._least.tolist())
        # Indices into the schedule: of the hardest gain that noise allows, and of the one in use.
        self._quiet = self._in_use = 0

    def restart(self) -> None:
        """Begin with the softest gain again, as x_hat starts anew and is noisy."""
        self.trust, self._newest = Trust(sharp_counts=1), None
        self.state = replace(self.state, width=1.0, asked=0.0, bounded=False,
                             blind_for=self._design.model.order)

    def take(self, estimate: Estimate, ideal: float, first: bool) -> bool:
        """Take in estimate and u* of this sample; return whether the estimate has changed."""
        trust, status, gap = self.trust, estimate.status, estimate.c_r - estimate.c_l
        another, self._newest = estimate is not self._newest, estimate
        if another:
            # While it is acquiring, as after a restart, a learned estimate is not yet confirmed. A
            # law without standard deviations has learned once it was tracking, and keeps that.
            trust.known = status not in (Status.ACQUIRING, Status.INCONSISTENT) and (
                trust.known or estimate.learned or status is Status.TRACKING)
            trust.crossings = shrunk_crossings(estimate, self.shrinkage, trust.known)
            # Before such a law first agrees with the data, its m may be anywhere.
            if isnan(trust.slope) or estimate.learned or status is Status.TRACKING:
                trust.slope = estimate.m
        self.state.asked, self.gap_u = max(self.state.asked, abs(ideal)), estimate.m * gap
        if not (trust.known and estimate.learned):
            # Without standard deviations there is no telling how far to rely on an estimate.
            trust.held_for = trust.in_use_for = 0
            return another
        trust.in_use_for += 1
        if first:  # the estimate was known before this loop began
            trust.held_for = TRUSTED_AFTER
        elif not trust.full:
            # Where u moves much further than the gap, a poorly known gap matters little.
            large = max(gap, self.state.width * max(self.state.asked, self.gap_u) / estimate.m)
            sharp = (estimate.std_m < SHARP * estimate.m
                     and estimate.std_c_r + estimate.std_c_l < SHARP * large)
            trust.held_for += trust.sharp_counts if sharp else 1
        return another

    def prepare(
        self, x_cov: Array | None, y_std: float, x_noise: Array, reference_std: float,
    ) -> None:
        """Choose the gain that noise allows; x_noise: see Plan.x_noise."""
        noise, deviation_std = self.noise, 0.0
        noise.x_known = x_cov is not None
        if x_cov is not None:
            if x_cov is not self._x_cov:  # it changes with a fit, not with every sample
                self._x_cov, self._of_x_hat = x_cov, variances(self._design.schedule, x_cov)
            stds = np.sqrt(np.maximum(self._of_x_hat + reference_std**2 * x_noise, 0.0))
            noise.x_std = max(self._of_x_hat.item(-1), 0.0)**0.5
            noise.u_std, deviation_std = np.maximum(stds[:-1], self._least).tolist(), stds.item(-1)
        # As much as v may leave uncorrected at rest: the same rule for motion and rest.
        noise.ignored = ARRIVED * max(CLOSE * y_std, UNCERTAIN * noise.x_std)
        # Noise of the references moves x*; where v did not follow, that shows as a deviation, too.
        noise.tolerated = max(noise.ignored, ARRIVED * UNCERTAIN * deviation_std)
        # The hardest gain with which noise moves u by no more than a tenth of m (c_r - c_l).
        most = 0.1 * self.gap_u or inf
        self._quiet = next((i for i, std in enumerate(noise.u_std) if std <= most),
                           len(noise.u_std) - 1)

    def deviation(self, x_hat: Sequence[float], x: Sequence[float]) -> list[float]:
        """Return x_hat - x*, or zeros while x_hat cannot be known."""
        if self.state.blind_for:
            self.state.blind_for -= 1
            return [0.0] * len(x)
        return [x_hat[i] - each for i, each in enumerate(x)]

    def u(self, error: Sequence[float], held_back: bool, largest: float) -> tuple[float, float]:
        """Return the feedback to subtract from u*, and how much of it is worth crossing the gap.

        error: x_hat - x*. held_back: whether v met its limits, or is crossing the gap. largest: the
        largest |x*| so far.
        """
        # Growth per sample of the bound while the backlash is unknown; free samples per step up.
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
            # K, or a softer gain while v does not follow or the estimate is new. If x is further
            # off than x* ever was and than noise explains, the noise in u does not matter.
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
                # A gap wider than the first guess has to be crossed eventually.
                state.width = min(widening * state.width, LARGEST_IN_ACQUISITION)
        if trust.full:
            by_integral = self._design.feedback.integral * state.integral
            feedback, worth = feedback + by_integral, worth + by_integral
        state.bounded = trust.held_for > 0 and not -most <= feedback <= most
        if isnan(feedback):
            return 0.0, 0.0
        return min(max(feedback, -most), most), min(max(worth, -most), most)

    def pull_back(self, deviation: Sequence[float]) -> float:
        """Return the u - u* that brings y back gently."""
        pull, most = -dot(self._design.gentle, deviation), self.bounds[0]
        return 0.0 if isnan(pull) else min(max(pull, -most), most)

    def furthest(
        self, deviation: Sequence[float], ahead: Sequence[float], side: Region, turns_in: int,
    ) -> float:
        """Return the furthest u that, if held, feedback will not ask back before u* turns."""
        by_state, by_u = self._design.holding[self._in_use]
        agreed = side * (by_state @ deviation + by_u @ ahead)[:turns_in]
        return side * float(agreed.min(initial=inf))

    def integrate(self, difference: float, limited: bool) -> None:
        """Integrate y* - y, except while v or feedback is saturated (anti-windup)."""
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
        """Standard deviation of the feedback that noise causes."""
        return self.noise.u_std[self._quiet]

    @property
    def bounds(self) -> tuple[float, float]:
        """Bound of the feedback, and bound of |u_d - u*| whatever makes u_d."""
        scale = max(self.state.asked, self.gap_u)
        if not self.trust.held_for:
            # A wrong slope may destabilise the loop; bounded feedback slows its growth down.
            return self.state.width * scale, LARGEST_IN_ACQUISITION * scale
        # A deviation that is tolerated at rest must never meet the bound.
        by_noise = TOLERANCE * self.y_std * hypot(*self._design.schedule[0])
        most = LARGEST_FEEDBACK * max(scale, by_noise)
        return most, most


class Mode(Enum):
    """How v moves at present."""

    FOLLOW = auto()  # the trajectory moves
    RETURN = auto()  # y is far away: full feedback brings it back
    # v steps to the u that holds G at rest, but short of it by the uncertainty of the crossing. The
    # error that remains shows in y, and is removed later in the same direction: no gap to cross.
    HOLD = auto()
    LEAD_BACK = auto()  # v steps to a u that brings y back into the tolerance, then to rest again

    @property
    def steps(self) -> bool:
        """Whether v moves in single steps only."""
        return self in (Mode.HOLD, Mode.LEAD_BACK)


@dataclass
class Rest:
    """Decides whether v rests, and makes its single steps."""

    mode: Mode = Mode.HOLD
    target: tuple[float, float] = (0.0, 0.0)  # u_d where v rests, and shrinkage of its crossing
    side: Region = GAP  # line in use at the sample before
    largest: float = 0.0  # largest |x*| so far
    limit: float = 0.0  # tolerance in use
    rested: int = 0  # samples for which the trajectory has rested
    returns: int = 0  # how often full feedback has brought y back meanwhile
    leads: int = 0  # how often gentle steps have
    turns: int = 0  # of v since full feedback began
    near: int = 0  # samples for which y has been within the tolerance
    pull: float = 0.0  # u - u* with which the newest LEAD_BACK began, 0 once y has stayed near
    began_at: float = 0.0  # |x_hat - x*| with which it did
    thrown: float = 0.0  # larger one that it led to: tolerated until y stays near without steps

    def decide(
        self, y: float, noise_std: float, plan: IdealTrajectory, deviation: Sequence[float],
        x_std: float | None, side: Region, pull_back: Callable[[Sequence[float]], float],
        acts: bool,
    ) -> Mode:
        """Set and return the mode for this sample.

        x_std: of |x_hat|, None if unknown. side: line in use. pull_back: gives the u - u* that
        brings y back gently. acts: whether feedback is larger than its noise.
        """
        self.largest = max(self.largest, hypot(*plan.x))
        least = 1e-5 * self.largest  # smallest tolerance
        still = 0.004 * max(TOLERANCE * noise_std, least)  # motion of x* per sample within a rest
        if plan.spread > noise_std or (self.mode is Mode.FOLLOW and plan.moved > still):
            self.mode, self.rested, self.near = Mode.FOLLOW, 0, 0
            self.returns = self.leads = 0
        elif x_std is None:
            off = abs(y - plan.references.window.item(0)) > OFF * noise_std
            self.mode = Mode.RETURN if off else Mode.HOLD
        else:
            self.rested += 1
            width = CLOSE if self.rested < SETTLING else TOLERANCE
            # If y has left again each time, the estimate is too poor to hold it closer.
            wider = 2.0 ** min(max(self.leads - MOST_RETURNS, 0), 10)
            narrow = max(width * noise_std, least, UNCERTAIN * x_std)
            self.limit = max(width * wider * noise_std, narrow, self.thrown)
            if self.mode is Mode.RETURN and side is not self.side:
                self.turns += 1
            size, pull = hypot(*deviation), pull_back(deviation)
            self._forget(size, narrow)
            self.mode = self._mode_at_rest(size, len(plan.x), pull, acts)
        self.side = side
        return self.mode

    def _forget(self, size: float, narrow: float) -> None:
        """Forget what did not bring y back, once y has stayed within the tolerance for a while."""
        self.near = self.near + 1 if size <= self.limit else 0
        if self.near < SETTLING:
            return
        self.returns = self.leads = 0
        if self.mode is Mode.HOLD:
            self.pull = 0.0
        if size <= narrow:
            self.thrown = 0.0

    def _mode_at_rest(self, size: float, order: int, pull: float, acts: bool) -> Mode:
        # Crossing the gap takes time, so that full feedback that keeps turning overshoots: after
        # MOST_RETURNS it is no longer allowed.
        returns = self.mode is Mode.RETURN
        if self.turns <= order if returns else self.returns < MOST_RETURNS:
            goes_on = not self.mode.steps and acts and size > ARRIVED * self.limit
            if goes_on or size > ASTRAY * self.limit:
                if not returns:
                    self.turns, self.returns = 0, self.returns + 1
                return Mode.RETURN
        if self.mode is Mode.LEAD_BACK:
            # While the pull keeps its direction and, once y is near, a quarter of its strength.
            least = 0.25 if size <= ARRIVED * self.limit else 0.0
            return Mode.LEAD_BACK if pull * self.pull > least * self.pull**2 else Mode.HOLD
        if size <= self.limit:
            return Mode.HOLD
        if pull * self.pull < 0.0 and size > self.began_at:
            self.thrown = size  # by the step before, as if the load coasts: no more of them
            return Mode.HOLD
        self.pull, self.began_at, self.leads = pull, size, self.leads + 1
        return Mode.LEAD_BACK

    def step(
        self, estimate: Estimate, plan: IdealTrajectory, pull: float, inverse: BacklashInverse,
        begins: bool,
    ) -> None:
        """Aim v at the u of this mode, if that is enough of an improvement over staying."""
        if inverse.taking_up or inverse.side is GAP:
            return  # still on its way, or the real u is not known yet
        ideal, engaged = plan.u, estimate.c_l if inverse.side is LEFT else estimate.c_r
        u = estimate.m * (inverse.v - engaged)
        if self.mode is Mode.LEAD_BACK:
            if not begins and (u - ideal) * pull >= 0.5 * pull * pull:
                return  # the u that is held is strong enough to bring y back
            u_d, shrinkage = ideal + pull, 0.0
        else:
            side_std = estimate.std_c_r if ideal > u else estimate.std_c_l
            away, uncertain = abs(ideal - u), SHORT * side_std * estimate.m
            # A step has to move x by a fraction of the tolerance, and to reduce the error of u.
            if not (away * plan.design.push > 0.25 * self.limit
                    and away > max(1.5 * uncertain, plan.noise_band)):
                return
            u_d, shrinkage = ideal, SHORT
        self.target = u_d, shrinkage
        inverse.aim(u_d, RIGHT if u_d > u else LEFT)


def shrunk_crossings(estimate: Estimate, deviations: float, known: bool) -> tuple[float, float]:
    """Return the crossings drawn together by so many of their standard deviations.

    Without standard deviations they are 0 until `known`. In a loop around y the smaller gap is the
    safe one: over-compensation starts a limit cycle, under-compensation leaves some backlash.
    """
    if isnan(estimate.std_c_r):  # a first guess, or a law that knows no uncertainty
        return (estimate.c_r, estimate.c_l) if known else (0.0, 0.0)
    if deviations == 0.0:
        return estimate.c_r, estimate.c_l
    middle = 0.5 * (estimate.c_r + estimate.c_l)
    return (max(estimate.c_r - deviations * estimate.std_c_r, middle),
            min(estimate.c_l + deviations * estimate.std_c_l, middle))
