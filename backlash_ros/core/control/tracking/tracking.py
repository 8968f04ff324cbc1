"""The structure in which y follows y_m: an ideal trajectory and feedback that holds y on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from math import isnan, nan, sqrt
from operator import mul, sub

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import (
    LARGEST_FEEDBACK,
    LARGEST_IN_ACQUISITION,
    Adoption,
    Command,
    ControlInput,
    Structure,
    dot,
)
from backlash_ros.core.control.tracking.design import (
    Replay,
    TrackingDesign,
    Weights,
    better_design_in_pieces,
    design,
)
from backlash_ros.core.control.tracking.reference_window import ReferenceWindow
from backlash_ros.core.control.tracking.rest import OFF, TOLERANCE, Mode, Rest
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import StateSource
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

STIFFEN_AFTER = 20  # samples without a limit after which feedback takes a step back to full
FADING = 0.8  # per sample, of what u_d of a new design differs by from that of the one before
WIDENING = 1.03  # per sample, of the bound on feedback while the backlash is unknown
# Samples for which an estimate has to hold before it gets full feedback: one that is confidently
# wrong is contradicted by then. Until then feedback hardens step by step.
TRUSTED_AFTER = 40
# A better design takes over when v does not move much: samples after the first estimate, by then v
# has crossed the gap with it; samples since the end of a crossing between which its last moves are
# over and the next one is not yet to be expected; samples without any after which none is.
SETTLED_AFTER, ENGAGED_SINCE, NO_CROSSING = 150, (5, 20), 100
FORESEEN = 6  # samples in which u* is neither to turn nor to hurry when another design takes over
# An estimate this sharp, in relative deviations of slope and gap, counts so many times per sample.
SHARP, SHARP_COUNTS = 0.01, 17

# Standard deviations of u_d within which a turn counts as noise. Wider bands hold v for so long
# that the feedback has to hurry afterwards, and cross the gap more often, not less.
NOISE_BAND = 0.5
# The same while the ideal trajectory, which has no noise, still goes on in the present direction.
ONWARD_BAND = 4.0


class Tracking:
    """u_d = u* - K (x - x*) - K_q (q - q*) around the ideal trajectory u*, x*, q* of G alone.

    The trajectory is what the LQ preview controller does without backlash, for the reference r,
    which is y_m delayed by the preview window: the delay is what the preview costs. Before the
    first reference has passed the window r is the output at the start, so that nothing jumps.
    While the backlash is unknown, the acquisition gain of the design replaces K: the trajectory
    itself excites the backlash. From the first estimate on the gains are those of its schedule, up
    to K. shrinkage: standard deviations by which the crossings are shrunk before they are inverted.
    noise_std: of y.

    x_cov is only looked into when it is another array than the sample before.
    """


    def __init__(
        self, beginning: TrackingDesign, weights: Weights, shrinkage: float, noise_std: float = 0.0,
    ) -> None:
        self.delay = weights.preview
        self._weights, self._shrinkage, self._noise_std = weights, shrinkage, noise_std
        self._references = ReferenceWindow(self.delay, beginning.model.memory)
        self._rest = Rest(beginning, noise_std)
        self._use(beginning)
        self._x = [0.0] * beginning.model.order  # x* and q* of the trajectory
        self._q = 0.0
        self._integral = 0.0
        self._ideal = 0.0  # u* of the sample before
        self._moves = deque([0.0], maxlen=NO_CROSSING)  # by which v moved of late, as sizes
        self._asked = 0.0  # largest |u*| so far
        self._scale = 0.0  # that, or the u that the gap takes
        self._bounded_before = False  # whether feedback has met its bound the sample before
        self._width = 1.0  # bound on feedback in scales, while the backlash is unknown
        self._estimate: Estimate | None = None  # the newest one; what follows is made of it
        self._known = False  # whether it comes from data
        self._slope = nan  # that of the newest one that the law stood by
        self._crossings = 0.0, 0.0  # shrunk by its uncertainty
        self._trusted_for, self._sharp_counts = 0, SHARP_COUNTS  # samples
        self._in_use_for = 0  # samples since an estimate is known
        self._engaged_for = 0  # samples since v has crossed the gap
        self._side = Region.GAP  # that is engaged
        self._level = self._free = 0  # in the schedule, while v does not follow; samples since
        self._scheduled = 0  # place of the gain in use
        self._u_d = 0.0  # of the sample before
        self._resumes = False  # whether this goes on from an interruption
        self._blind_for = 1  # samples from now on in which x_hat cannot be known
        self._handover = 0.0  # what is still added to u_d since another design took over

    @property
    def model(self) -> StateModel:
        """The model of G whose gains are in use."""
        return self._design.model

    @property
    def may_change(self) -> bool:
        """Whether v neither crosses the gap nor is about to."""
        since, (first, last) = self._engaged_for, ENGAGED_SINCE
        return self._in_use_for >= SETTLED_AFTER and (
            first <= since <= last or since >= NO_CROSSING
        ) and self._goes_on()

    def _goes_on(self) -> bool:
        """Whether u* neither turns soon nor asks for larger moves of v than those of late.

        As far as the references that are known say.
        """
        fastest = self._slope * max(self._moves)
        window, x, before = self._references.window, self._x, self._ideal
        for _ in range(FORESEEN):
            window = np.append(window[1:], window[-1])
            ideal, x = self._trajectory(x, window)
            move = (ideal - before) * self._side
            if not 0.0 <= move <= fastest:
                return False
            before = ideal
        return True

    def _use(self, chosen: TrackingDesign) -> None:
        model, gains, feedback = chosen.model, chosen.gains, chosen.feedback.gain
        self._design = chosen
        self._transition: list[tuple[list[float], float]] = list(
            zip(model.a.tolist(), model.b.tolist(), strict=True)
        )
        self._k: list[float] = gains.state.tolist()
        self._schedule: list[list[float]] = [gain.tolist() for gain in (feedback, *chosen.schedule)]
        # What an error of y calls for that would not matter at rest: never too much feedback.
        self._tolerated = TOLERANCE * self._noise_std * float(np.linalg.norm(feedback))
        self._acquisition_gain = None if chosen.acquisition is None else chosen.acquisition.tolist()
        self._x_cov: Array | None = None
        self._x_std = self._feedback_std = 0.0  # of x_hat and of K x_hat, as in x_cov

    def go_on_from(self, other: Structure, state_known: bool = True) -> None:
        """Take over the trajectory, and the model of G that it is one of."""
        if not isinstance(other, Tracking) or other.delay != self.delay:
            return
        if other.model is not self.model:
            self._use(design(other.model, self._weights))
            self._rest.use(self._design)
        self._references, self._x, self._q = other._references, other._x, other._q
        self._integral, self._ideal, self._u_d = other._integral, other._ideal, other._u_d
        self._moves = other._moves
        self._level, self._free, self._scheduled = other._level, other._free, other._scheduled
        self._handover, self._sharp_counts = other._handover, other._sharp_counts
        self._rest.go_on_from(other._rest)
        if state_known:
            self._trusted_for, self._width = other._trusted_for, other._width
            self._in_use_for, self._engaged_for = other._in_use_for, other._engaged_for
            self._asked, self._known, self._side = other._asked, other._known, other._side
            self._resumes, self._blind_for = other._resumes, other._blind_for
            self._slope = other._slope
        else:
            # However well the backlash is known, the first x_hat are full of noise.
            self._resumes, self._blind_for, self._sharp_counts = True, self.model.order, 1

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        estimate, gains = inputs.estimate, self._design.gains
        if estimate is not self._estimate:
            self._note_estimate(estimate)
        first = self._references.empty
        if first:
            self._begin(inputs)
        elif self._resumes:
            self._references.lead_to(inputs.y_m)
        window = self._references.append(inputs.y_m)
        x = self._x
        ideal, onward = self._trajectory(x, window)
        if self._blind_for:
            self._blind_for -= 1
            deviation = [0.0] * len(x)
        else:
            deviation = list(map(sub, inputs.x_hat, x))
        x_cov = inputs.x_cov
        if x_cov is not self._x_cov:
            self._note_covariance(x_cov)
        self._asked = max(self._asked, abs(ideal))
        self._scale = max(self._asked, estimate.m * (estimate.c_r - estimate.c_l))
        trusted = self._is_trusted(estimate, first)
        if self._trusted_for > 0:
            held_back = self._bounded_before or inverse.limited or inverse.taking_up
            feedback = dot(self._gain(held_back), deviation)
        else:
            feedback = self._acquisition_feedback(deviation)
        if trusted and gains.integral:
            feedback += self._design.feedback.integral * (self._integral - self._q)
        most = LARGEST_FEEDBACK * max(self._scale, self._tolerated)
        self._bounded_before = bounded = not -most <= feedback <= most
        if bounded:
            feedback = min(max(feedback, -most), most) if feedback == feedback else 0.0
        u_d = ideal - feedback
        rest, handed_over = self._rest, 0.0
        if self._resumes or self._handover:
            u_d, handed_over = self._with_handover(u_d, inverse)
        before = rest.mode
        mode = rest.decide(
            inputs.y, window, x, onward, deviation,
            None if x_cov is None else self._x_std, inverse.side,
            most if self._trusted_for > 0 else self._acquisition_bound,
        )
        crossings = self._crossings
        if mode is Mode.FOLLOW:
            inverse.widen_band(self._noise_band(ideal, inverse))
        else:
            if x_cov is not None:
                rest.step(estimate, ideal, deviation, inverse, mode is not before)
            elif before is Mode.FOLLOW:
                rest.stay(ideal)
            u_d = rest.u_d
            crossings = shrunk_crossings(estimate, rest.shrinkage, self._known)
            inverse.widen_band(0.0)
        # Whatever has made u_d: nothing leads it further from what the reference asks for.
        reach = most if self._trusted_for > 0 else LARGEST_IN_ACQUISITION * self._scale
        reach += abs(handed_over)
        u_d = min(max(u_d, ideal - reach), ideal + reach)
        self._ideal, self._x, self._u_d = ideal, onward, u_d
        side, before_v = inverse.side, inverse.v
        v = inverse.step(u_d, self._slope, *crossings)
        self._moves.append(abs(v - before_v))
        self._side = inverse.side
        crosses = inverse.taking_up or self._side is not side
        self._engaged_for = 0 if crosses else self._engaged_for + 1
        if gains.integral:
            self._integrate(window.item(0), inputs.y, x[0], trusted, bounded or inverse.limited)
        return Command(u_d, v, 0.0)

    def _with_handover(self, u_d: float, inverse: BacklashInverse) -> tuple[float, float]:
        """u_d with what was handed over to this loop, which fades, and how much that is."""
        if self._resumes:
            self._resumes = False
            together = inverse.resume(self._slope, *self._crossings)
            handed_over = together - u_d
            self._rest.stay(together)
        else:
            together = u_d + self._handover
            handed_over = self._handover if together != u_d else 0.0
        self._handover = FADING * handed_over
        return together, handed_over

    def design(self, model: StateModel) -> Iterator[Adoption | None]:
        """Redesign for a better model, see `better_design_in_pieces`."""
        new = yield from better_design_in_pieces(model, self._weights, self._design)
        if new is not None:
            replay = Replay(new, self._references.history)
            yield None
            yield partial(self._adopt, new, replay)

    def _adopt(self, new: TrackingDesign, replay: Replay, source: StateSource) -> None:
        """Go on with the new design as if it had been in use for as long as is remembered.

        What its u_d differs by from that of the sample before fades.
        """
        self._use(new)
        self._rest.use(new)
        if self._references.empty:
            self._x = [0.0] * new.model.order
            return
        x, q = replay.state(self._references.all())
        self._integral, self._q = q + self._integral - self._q, q
        window = self._references.window
        ideal, onward = self._trajectory(x, window)
        deviation = list(map(sub, source.x_hat, x))
        if self._trusted_for > 0:
            feedback = dot(self._schedule[self._scheduled], deviation)
        else:
            feedback = self._bounded(deviation)
        if self._trusted_for >= TRUSTED_AFTER:
            feedback += new.feedback.integral * (self._integral - q)
        # The plant is at the next sample when the next command is made.
        self._q += window.item(0) - new.model.c * x[0]
        self._ideal, self._x = ideal, onward
        self._handover = FADING * (self._u_d - ideal + feedback)

    def _trajectory(self, x: list[float], window: Array) -> tuple[float, list[float]]:
        """u* for x* and the references from now on, and the x* of the next sample."""
        gains = self._design.gains
        ideal = -dot(self._k, x) - float(gains.preview.dot(window))
        if gains.integral:
            ideal -= gains.integral * self._q
        # Without the call of `dot`: this is made at every sample.
        return ideal, [sum(map(mul, row, x)) + b * ideal for row, b in self._transition]

    def _begin(self, inputs: ControlInput) -> None:
        start, noise = inputs.y, OFF * self._noise_std
        # What may be noise is no distance to go: a loop at rest stays at rest.
        near = abs(start - inputs.y_m) <= noise
        r = inputs.y_m if near else start
        self._references.fill(r)
        # No v has acted yet, so nobody knows the state better than rest at y.
        self._x = (self._design.model.equilibrium * r).tolist()

    def _gain(self, limited: bool) -> list[float]:
        """K, or the less of it the longer v does not follow, and the newer the estimate.

        limited: whether v met its limits, was on its way across the gap, or feedback at its bound.
        """
        self._free = 0 if limited else self._free + 1
        if limited:
            self._level = min(self._level + 1, len(self._schedule) - 1)
        elif self._level > 0 and self._free % STIFFEN_AFTER == 0:
            self._level -= 1
        levels = len(self._schedule)
        unproven = levels - 1 - self._trusted_for * levels // TRUSTED_AFTER
        self._scheduled = max(self._level, unproven)
        return self._schedule[self._scheduled]

    def _acquisition_feedback(self, deviation: Sequence[float]) -> float:
        """Feedback while the backlash is unknown: no larger than the trajectory or the gap asks.

        A wrong slope may make the loop unstable, which bounded feedback slows down. The bound
        widens while it is met, up to LARGEST_IN_ACQUISITION: a gap wider than the first guess has
        to be crossed some day.
        """
        feedback = self._bounded(deviation)
        if abs(feedback) == self._acquisition_bound:
            self._width = min(WIDENING * self._width, LARGEST_IN_ACQUISITION)
        return feedback

    @property
    def _acquisition_bound(self) -> float:
        """Largest |u - u*| while the backlash is unknown."""
        return self._width * self._scale

    def _bounded(self, deviation: Sequence[float]) -> float:
        """Feedback of the acquisition within its bound."""
        if self._acquisition_gain is None:
            return 0.0
        bound = self._acquisition_bound
        return min(max(dot(self._acquisition_gain, deviation), -bound), bound)

    def _is_trusted(self, estimate: Estimate, first: bool) -> bool:
        """Whether the estimate gets full feedback; counts the samples for which it has held.

        Without deviations nobody knows how far it may be relied on, and feedback stays that of the
        acquisition.
        """
        if not (self._known and estimate.learned):
            self._trusted_for = self._in_use_for = 0
            return False
        self._in_use_for += 1
        if first:
            self._trusted_for = TRUSTED_AFTER
        if self._trusted_for < TRUSTED_AFTER:
            sharp = _is_sharp(estimate, self._acquisition_bound)
            self._trusted_for += self._sharp_counts if sharp else 1
        return self._trusted_for >= TRUSTED_AFTER

    def _note_estimate(self, estimate: Estimate) -> None:
        self._estimate = estimate
        self._known = _is_known(estimate, self._known)
        self._crossings = shrunk_crossings(estimate, self._shrinkage, self._known)
        # On the way to its first agreement with the data the m of a law without deviations may be
        # anywhere within its bounds.
        if isnan(self._slope) or estimate.learned or estimate.status is Status.TRACKING:
            self._slope = estimate.m

    def _note_covariance(self, x_cov: Array | None) -> None:
        self._x_cov = x_cov
        if x_cov is None:
            self._x_std = self._feedback_std = 0.0
            return
        rows: list[list[float]] = x_cov.tolist()
        gain = self._schedule[0]
        variance = dot(gain, [dot(row, gain) for row in rows])
        self._feedback_std = sqrt(max(variance, 0.0))
        self._x_std = sqrt(max(sum(row[i] for i, row in enumerate(rows)), 0.0))

    def _noise_band(self, ideal: float, inverse: BacklashInverse) -> float:
        # Where x has no covariance no noise of it enters u_d, and a turn is one.
        onward = (ideal - self._ideal) * inverse.side >= 0.0
        return (ONWARD_BAND if onward else NOISE_BAND) * self._feedback_std

    def _integrate(self, r: float, y: float, x_0: float, trusted: bool, limited: bool) -> None:
        if not trusted:
            self._integral = self._q
        elif not limited:
            # A saturated actuator cannot follow: integrating on would only wind up.
            self._integral += r - y
        self._q += r - self._design.model.c * x_0


def _is_known(estimate: Estimate, before: bool) -> bool:
    """Whether an estimate comes from data of this loop; before: whether the one before it did."""
    status = estimate.status
    if status in (Status.ACQUIRING, Status.INCONSISTENT):
        # What was learned before a restart says nothing yet about the state of G.
        return False
    # A law without deviations says by its status alone that it has learned, and holds that later.
    return before or estimate.learned or status is Status.TRACKING


def _is_sharp(estimate: Estimate, u_scale: float) -> bool:
    # Beside far larger u even a gap that is hardly known makes little difference.
    large = max(estimate.c_r - estimate.c_l, u_scale / estimate.m)
    std_gap = estimate.std_c_r + estimate.std_c_l
    return estimate.std_m < SHARP * estimate.m and std_gap < SHARP * large


def shrunk_crossings(
    estimate: Estimate, deviations: float, known: bool,
) -> tuple[float, float]:
    """Crossings shrunk towards each other by their uncertainty; both 0 while nothing is known.

    Over-compensation drives past the gap and starts a limit cycle, under-compensation only
    leaves a rest of the backlash: in a loop around y the smaller gap is the safe one. Where a law
    knows no uncertainty there is nothing to shrink by once the crossings are known.
    """
    if deviations == 0.0:
        return estimate.c_r, estimate.c_l
    if isnan(estimate.std_c_r):
        return (estimate.c_r, estimate.c_l) if known else (0.0, 0.0)
    middle = 0.5 * (estimate.c_r + estimate.c_l)
    return (
        max(estimate.c_r - deviations * estimate.std_c_r, middle),
        min(estimate.c_l + deviations * estimate.std_c_l, middle),
    )
