"""The structure in which y follows y_m: an ideal trajectory and feedback that holds y on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from operator import sub

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import Command, ControlInput, Structure
from backlash_ros.core.control.tracking.design import (
    TrackingDesign,
    Weights,
    better_design,
    design,
)
from backlash_ros.core.control.tracking.feedback import StateFeedback
from backlash_ros.core.control.tracking.handover import HandOver
from backlash_ros.core.control.tracking.rest import OFF, Mode, Rest
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.control.tracking.trust import Trust, shrunk_crossings
from backlash_ros.core.law import StateSource
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.noise_level import NoiseLevel
from backlash_ros.core.plant.state_model import StateModel

# A better design takes over when v does not move much: samples after the first estimate, by then v
# has crossed the gap with it; samples since the end of a crossing between which its last moves are
# over and the next one is not yet to be expected; samples without any after which none is.
SETTLED_AFTER, ENGAGED_SINCE, NO_CROSSING = 150, (5, 20), 100
BEYOND = 0.3  # deviations of noise in feedback, that u_d may go further onward than u* soon is
IN_FEEDBACK = 4.0  # times the noise of u* that feedback makes of the same noise
ROUNDING = 1e-9  # relative, of u*
NOISE_BAND = 4.0  # deviations of the noise in feedback that are worth a crossing of the gap
FORESEEN = 6  # samples in which u* is neither to turn nor to hurry when another design takes over


class Tracking:
    """u_d = u* - K (x - x*) - K_q (q - q*) around the ideal trajectory u*, x*, q* of G alone.

    The trajectory is what the LQ preview controller does without backlash, for the reference r,
    which is y_m delayed by the preview window: the delay is what the preview costs. Before the
    first reference has passed the window r is the output at the start, so that nothing jumps.
    Where the trajectory rests, v moves in single steps. shrinkage: standard deviations by which the
    crossings are shrunk before they are inverted. noise_std: of y.
    """


    def __init__(
        self, beginning: TrackingDesign, weights: Weights, shrinkage: float, noise_std: float = 0.0,
    ) -> None:
        self.delay = weights.preview
        self._weights, self._noise_std, self._design = weights, noise_std, beginning
        self.trust = Trust(shrinkage)
        self.trajectory = IdealTrajectory(beginning, noise_std)
        self.feedback = StateFeedback(beginning, self.trust, noise_std)
        self.rest = Rest(beginning, noise_std)
        self.hand_over = HandOver()
        self._y_noise = NoiseLevel()
        self._moves = deque([0.0], maxlen=NO_CROSSING)  # by which v moved of late, as sizes
        self._engaged_for = 0  # samples since v has crossed the gap

    @property
    def model(self) -> StateModel:
        """The model of G whose gains are in use."""
        return self._design.model

    @property
    def may_change(self) -> bool:
        """Whether v neither crosses the gap nor is about to."""
        since, (first, last) = self._engaged_for, ENGAGED_SINCE
        if self.trust.state.in_use_for < SETTLED_AFTER or not (
            first <= since <= last or since >= NO_CROSSING
        ):
            return False
        # Neither a turn soon nor larger moves of v than those of late, as far as references say.
        fastest = self.trust.state.slope * max(self._moves)
        side, ahead = self.trajectory.state.side, self.trajectory.ahead[:FORESEEN + 1]
        rounding = ROUNDING * max(map(abs, ahead))
        return all(
            -rounding <= (after - before) * side <= fastest + rounding
            for before, after in pairwise(ahead)
        )

    def go_on_from(self, other: Structure, state_known: bool = True) -> None:
        """Take over the trajectory, and the model of G that it is one of."""
        if not isinstance(other, Tracking) or other.delay != self.delay:
            return
        if other.model is not self.model:
            self._use(design(other.model, self._weights))
        self.trust.go_on_from(other.trust, state_known)
        self.trajectory.go_on_from(other.trajectory)
        self.feedback.go_on_from(other.feedback, state_known)
        self.rest.go_on_from(other.rest)
        self._moves, self._engaged_for = other._moves, other._engaged_for
        self.hand_over.from_rest(leading=not state_known)

    def redesign(self, model: StateModel) -> Callable[[], object | None]:
        """See `better_design`."""
        return partial(better_design, model, self._weights, self._design)

    def adopt(self, gains: object, source: StateSource) -> None:
        """Go on with a design as if it had been in use for as long as references are kept."""
        assert isinstance(gains, TrackingDesign)
        self._use(gains)
        trajectory, before = self.trajectory, self.trajectory.references.empty
        trajectory.replay()
        if not before:
            deviation = list(map(sub, source.x_hat, trajectory.state.x))
            self.hand_over.from_u_d(trajectory.u - self.feedback.peek(deviation))
            trajectory.advance()  # the plant is at the next sample when the next command is made

    def _use(self, chosen: TrackingDesign) -> None:
        self._design = chosen
        self.trajectory.use(chosen)
        self.feedback.use(chosen)
        self.rest.use(chosen)

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        estimate, trust, trajectory = inputs.estimate, self.trust, self.trajectory
        feedback, x_cov = self.feedback, inputs.x_cov
        first = trajectory.references.empty
        self._y_noise.take(inputs.y)
        trajectory.noise_std = max(self._noise_std, self._y_noise.std)
        follows = self.rest.state.mode is Mode.FOLLOW and not inverse.taking_up
        if trust.take(estimate) and follows and not first:
            self.hand_over.to_estimate(inverse, trust.state)
        self._take_reference(inputs, first)
        x, ideal = trajectory.state.x, trajectory.u
        deviation = feedback.deviation(inputs.x_hat, x)
        feedback.take_covariance(x_cov)
        feedback.ask(ideal, estimate)
        trust.count(estimate, first, feedback.acquisition_bound)
        held_back = inverse.limited or inverse.taking_up
        before_turn = trajectory.state.side
        asked = trajectory.turn(inverse.direction_band, inputs.crossing)
        correction = feedback.u(deviation, held_back)
        u_d = trajectory.onward_u - correction
        # What the noise of the references makes of u* and is not followed shows as a deviation.
        noise = NOISE_BAND * feedback.noise + IN_FEEDBACK * trajectory.noise_band
        if trust.full and abs(correction) < noise:
            u_d = trajectory.bounded(u_d, BEYOND * feedback.noise)
        u_d, handed_over = self.hand_over.apply(u_d, inverse, trust.state)
        side = self._side(asked, asked is not before_turn, u_d, noise, inverse)
        crossings = trust.state.crossings
        rest, before = self.rest.state, self.rest.state.mode
        mode = self.rest.decide(
            inputs.y, trajectory.references.window, x, trajectory.onward, deviation,
            None if x_cov is None else feedback.x_std, inverse.side,
            feedback.most if trust.begun else feedback.acquisition_bound,
        )
        follows = mode is Mode.FOLLOW
        if not follows:
            if x_cov is not None:
                self.rest.step(estimate, ideal, deviation, inverse, mode is not before)
            elif before is Mode.FOLLOW:
                self.rest.stay(inverse)
            u_d = rest.u_d
            crossings = shrunk_crossings(estimate, rest.shrinkage, trust.state.known)
        # Whatever has made u_d: nothing leads it further from what the reference asks for.
        reach = feedback.reach + handed_over
        u_d = min(max(u_d, ideal - reach), ideal + reach)
        v = self._invert(u_d, side if follows else None, crossings, inverse)
        feedback.integrate(self.model.c * x[0] - inputs.y, inverse.limited)
        trajectory.advance()
        return Command(u_d, v, 0.0)

    def _take_reference(self, inputs: ControlInput, first: bool) -> None:
        y_m, trajectory = inputs.y_m, self.trajectory
        if first:
            # What may be noise is no distance to go: a loop at rest stays at rest.
            near = abs(inputs.y - y_m) <= OFF * self._noise_std
            trajectory.begin(y_m if near else inputs.y)
        elif self.hand_over.leading:
            trajectory.references.lead_to(y_m)
        trajectory.take(y_m)

    def _side(
        self, asked: Region, turned: bool, u_d: float, noise: float, inverse: BacklashInverse,
    ) -> Region:
        """Return the side of the gap for u_d.

        A crossing costs wear and noise. The trajectory has no noise and is known ahead, so it
        decides: asked; turned says whether it asks so since this sample. Feedback may ask for the
        other side as well, where y is pushed, by more than noise: what of u_d may be noise.
        """
        c_r, c_l = self.trust.state.crossings
        if c_r == c_l and asked is not Region.GAP and u_d != inverse.held_u:
            return Region.RIGHT if u_d > inverse.held_u else Region.LEFT  # nothing is crossed
        side = inverse.side
        if asked is Region.GAP or side is Region.GAP:
            return asked
        back, come_back = (inverse.held_u - u_d) * side, self.trajectory.back
        if turned:
            # Limits may have kept v so far behind that u still has to go on.
            return asked if side is asked or back > -(noise + come_back) else side
        # Where feedback turned before the trajectory does, that is no reason to turn again.
        band = come_back + (noise if side is asked else 0.0)
        return Region(-side) if back > max(band, inverse.direction_band) else side

    def _invert(
        self, u_d: float, side: Region | None, crossings: Sequence[float],
        inverse: BacklashInverse,
    ) -> float:
        """Return v; side: line for u_d, None where v steps to rest."""
        before, v_before = inverse.side, inverse.v
        c_r, c_l = crossings
        slope = self.trust.state.slope
        if side is None:
            v = inverse.proceed(slope, c_r, c_l)
        else:
            v = inverse.follow(side, u_d, slope, c_r, c_l)
        self._moves.append(abs(v - v_before))
        crosses = inverse.taking_up or inverse.side is not before
        self._engaged_for = 0 if crosses else self._engaged_for + 1
        self.hand_over.note(u_d)
        return v
