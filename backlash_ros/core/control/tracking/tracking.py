"""The structure in which y follows y_m: an ideal trajectory and feedback that holds y on it."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import ControlInput, ControlStructure
from backlash_ros.core.control.tracking.design import TrackingDesign, better_design, design
from backlash_ros.core.control.tracking.feedback import OFF, Rest, StateFeedback, shrunk_crossings
from backlash_ros.core.control.tracking.trajectory import WORTH_CROSSING, IdealTrajectory
from backlash_ros.core.law import Law
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import TrackingWeights
from backlash_ros.core.plant.backlash import GAP, LEFT, RIGHT, Region
from backlash_ros.core.plant.numerics import NoiseLevel
from backlash_ros.core.plant.transfer_function import StateModel

FADING = 0.8  # per sample, of HandOver.added


@dataclass
class HandOver:
    """Bumpless transfer: with new gains, or after an interruption, v continues from where it is."""

    # Added to u_d, and fading: the u_d that v stands for, minus `due`.
    added: float = 0.0
    due: float | None = None  # the u_d that the loop asks for when v is handed over to it
    widens: bool = False  # whether `added` may lead u_d further from u* than feedback may
    leading: bool = False  # whether the reference may have moved on during an interruption


class Tracking(ControlStructure):
    """u_d = u* - K (x - x*) - K_q (q - q*) around the ideal trajectory u*, x*, q* of G alone.

    The trajectory is that of the LQ preview controller without backlash, for y_m delayed by the
    preview window, which is filled with the first output. While it rests, v moves in single steps.
    shrinkage: standard deviations by which the crossings are shrunk. noise_std: of y.
    """

    def __init__(
        self, beginning: TrackingDesign, weights: TrackingWeights, shrinkage: float,
        noise_std: float = 0.0,
    ) -> None:
        self.delay = weights.preview
        self._weights = weights
        self.trajectory = IdealTrajectory(beginning)
        self.feedback = StateFeedback(beginning, shrinkage, noise_std)
        self.rest, self.hand_over = Rest(), HandOver()
        self._noise_std, self._y_noise = noise_std, NoiseLevel()
        self._moves = deque([0.0], maxlen=100)  # sizes of the newest moves of v
        self._engaged_for = 0  # samples since v has crossed the gap
        # y and the source of x_hat at the newest command, for `prepare`.
        self._newest: tuple[float, Law] | None = None

    @property
    def may_change(self) -> bool:
        """Whether v neither crosses the gap nor is about to."""
        # Samples after the first estimate, until v has crossed the gap with it; after a crossing,
        # until its last moves are over; ahead, in which u* must not turn or speed v up.
        settled_after, engaged_after, foreseen = 150, 5, 6
        trust, plan = self.feedback.trust, self.trajectory
        if trust.in_use_for < settled_after or self._engaged_for < engaged_after:
            return False
        fastest, ahead = trust.slope * max(self._moves), plan.ahead[:foreseen + 1]
        rounding = 1e-9 * max(map(abs, ahead))
        return all(-rounding <= (after - before) * plan.turning.side <= fastest + rounding
                   for before, after in pairwise(ahead))

    # --- taking over ----------------------------------------------------------------------------

    def restart(self) -> None:
        self.feedback.restart()
        self.hand_over = HandOver(due=self.trajectory.u, widens=True, leading=True)

    def retune(self, p: Parameters, source: Law) -> bool:
        feedback, tuning = self.feedback, (
            p.tracking, p.inverse.caution, p.estimator.output_noise_std)
        changed = tuning != (self._weights, feedback.shrinkage, feedback.y_std)
        if changed:
            present = self.trajectory.design
            gains = design(present.model, p.tracking, present.factor)
            self._weights, feedback.shrinkage, feedback.y_std = tuning
            self.adopt(gains, source)
        return changed

    def redesign(self, model: StateModel) -> Callable[[], object | None]:
        return partial(better_design, model, self._weights, self.trajectory.design)

    def adopt(self, gains: object, source: Law) -> None:
        """Switch to a design as if it had been in use since the oldest reference that is kept."""
        assert isinstance(gains, TrackingDesign)
        self.prepare()
        self.trajectory.use(gains, self.trajectory.softness)
        self.feedback.use(gains)
        self.feedback.prepare(source.x_cov, self._noise_std, *self.trajectory.noise)
        self._change_trajectory(source)

    def _change_trajectory(self, source: Law) -> None:
        """Replay the trajectory with the plan now in use, and hand v over without a jump."""
        trajectory, feedback = self.trajectory, self.feedback
        if trajectory.references.empty:
            return
        trajectory.replay()
        state = replace(feedback.state)
        deviation = feedback.deviation(source.x_hat, trajectory.x)
        due = trajectory.u - feedback.u(deviation, False, self.rest.largest)[0]
        feedback.state = state  # undo what feedback.u changed: no sample has passed
        self.hand_over = HandOver(due=due, widens=True, leading=self.hand_over.leading)
        trajectory.advance()  # the plant is at the next sample when the next command is made

    # --- at every sample ------------------------------------------------------------------------

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> float:
        """Return u_d, and have the inverse compute v from it."""
        y_m, y, estimate, source, limits = inputs
        self.prepare()
        plan, feedback, rest, hand_over = self.trajectory, self.feedback, self.rest, self.hand_over
        first = plan.references.empty
        if first:
            # If y differs from y_m by noise only, begin at y_m: a loop at rest stays at rest.
            plan.begin(y_m if abs(y - y_m) <= OFF * self._noise_std else y)
        elif hand_over.leading:
            plan.lead_to(y_m)
        hand_over.leading = False
        plan.take(y_m)
        follows = not (rest.mode.steps or inverse.taking_up)
        if feedback.take(estimate, plan.u, first) and follows and hand_over.due is None:
            hand_over.due = inverse.extreme  # the u_d that led to v with the previous estimate
        if hand_over.due is not None:
            stands_for = inverse.resume(feedback.trust.slope, *feedback.trust.crossings)
            if inverse.side is not GAP:
                hand_over.added += stands_for - hand_over.due
            hand_over.due = None
        deviation = feedback.deviation(source.x_hat, plan.x)
        gap = estimate.c_r - estimate.c_l
        crossing = max(gap / inverse.take_up, limits.samples_across(gap))
        turned = plan.turn(self._noise_std, feedback.gap_u, inverse.direction_band, crossing)
        correction, worth = feedback.u(
            deviation, inverse.limited or inverse.taking_up, rest.largest)
        noise = 4.0 * feedback.noise_u + plan.noise_band
        u_d = plan.aim - correction
        if feedback.knows_noise:
            u_d = self._without_crossing(u_d, plan.aim - worth, noise, deviation, inverse)
        added = hand_over.added
        hand_over.added *= FADING
        u_d += added
        before = rest.mode
        mode = rest.decide(y, self._noise_std, plan, deviation,
                           feedback.noise.x_std if feedback.noise.x_known else None, inverse.side,
                           feedback.pull_back, abs(correction) > noise)
        steps = mode.steps
        if steps and mode is not before:
            rest.target = inverse.extreme, 0.0  # stay where v is
        if steps and feedback.noise.x_known:
            rest.step(estimate, plan, feedback.pull_back(deviation), inverse, mode is not before)
        side = self._side(turned, u_d, noise, inverse)
        # However u_d was made, it stays this close to what the reference asks for.
        reach = feedback.bounds[1] + (abs(added) if hand_over.widens else 0.0)
        u_d = min(max(rest.target[0] if steps else u_d, plan.u - reach), plan.u + reach)
        side_before, v_before, trust = inverse.side, inverse.v, feedback.trust
        if steps:
            shrunk = shrunk_crossings(estimate, rest.target[1], trust.known)
            inverse.proceed(trust.slope, *shrunk)
        else:
            inverse.follow(side, u_d, trust.slope, *trust.crossings)
        self._moves.append(abs(inverse.v - v_before))
        crosses = inverse.taking_up or inverse.side is not side_before
        self._engaged_for = 0 if crosses else self._engaged_for + 1
        feedback.integrate(plan.design.model.c * plan.x[0] - y, inverse.limited)
        self._newest = y, source
        return u_d

    def prepare(self) -> None:
        """Prepare the next sample, unless that has been done already."""
        if self._newest is not None:
            y, source = self._newest
            self._newest = None
            self._y_noise.take(y)
            self._noise_std = max(self.feedback.y_std, self._y_noise.std)
            self.trajectory.prepare()
            self.feedback.prepare(source.x_cov, self._noise_std, *self.trajectory.noise)
            if self.feedback.trust.full and self.trajectory.soften(self.feedback.gap_u):
                self._change_trajectory(source)

    def _without_crossing(
        self, wanted: float, worth: float, noise: float, deviation: Sequence[float],
        inverse: BacklashInverse,
    ) -> float:
        """Return u_d: `wanted` as far as that costs no crossing of the gap, else `worth`."""
        # A u behind the one that is held makes v cross the gap. One beyond the furthest u* has to
        # come back across it, so it must be more than noise. Otherwise u goes no further than
        # feedback will agree with until u* turns, except while v is handed over.
        plan, side, (c_r, c_l) = self.trajectory, inverse.side, self.feedback.trust.crossings
        if side is GAP or side is not plan.turning.side or c_r == c_l:
            return worth
        held = inverse.held_u * side
        least, most = min(worth * side, held), max(plan.turning.furthest * side, held)
        if plan.turning.stays:  # what goes beyond where u* comes to rest has to come back
            most = max(plan.aim * side, held)
        elif worth * side > most + noise:
            most = worth * side
        elif abs(self.hand_over.added) <= noise and wanted * side > max(plan.aim * side, held):
            furthest = self.feedback.furthest(deviation, plan.ahead, side, plan.turning.turns_in)
            most = max(min(most, furthest * side), plan.aim * side, held)
        return min(max(wanted * side, least), most) * side

    def _side(self, turned: bool, u_d: float, noise: float, inverse: BacklashInverse) -> Region:
        """Return the side of the gap for u_d; turned: whether the side of u* has changed.

        The trajectory decides, as it is free of noise and known ahead. Feedback may ask for the
        other side as well if y is pushed, by more than the noise in u_d.
        """
        plan, side, (c_r, c_l) = self.trajectory, inverse.side, self.feedback.trust.crossings
        asked = plan.turning.side
        if c_r == c_l and asked is not GAP and u_d != inverse.held_u:
            return RIGHT if u_d > inverse.held_u else LEFT  # there is no gap to cross
        if asked is GAP or side is GAP:
            return asked
        back = (inverse.held_u - u_d) * side
        if turned:
            # Limits may have kept v so far behind that u still has to move on in its direction.
            return asked if side is asked or back > -(noise + plan.back) else side
        # If feedback turned before the trajectory, the old side of u* is no reason to turn back.
        band = plan.back + (noise if side is asked else 0.0)
        if plan.turning.stays:
            band = max(band, WORTH_CROSSING * self.feedback.gap_u)
        return Region(-side) if back > max(band, inverse.direction_band) else side
