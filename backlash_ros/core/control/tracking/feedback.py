"""Feedback that holds x on the ideal trajectory: K (x_hat - x*) + K_q (q - q*), within bounds.

A deviation that noise explains is left alone. What is beyond is fed back as hard as the estimate of
the backlash is trusted: the first one may be confidently wrong, which the samples after it
contradict. So feedback hardens as it holds, and softens while v does not follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, isnan, nan

import numpy as np

from backlash_ros.core.control.structure import LARGEST_FEEDBACK, LARGEST_IN_ACQUISITION
from backlash_ros.core.control.tracking.design import SOFTEST, TrackingDesign, dot
from backlash_ros.core.control.tracking.rest import ARRIVED, ASTRAY, CLOSE, TOLERANCE, UNCERTAIN
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.transfer_function import Array

TRUSTED_AFTER = 40  # samples for which an estimate has to hold before it gets full feedback
# An estimate this sharp, in relative deviations of slope and gap, counts so many times per sample.
SHARP, SHARP_COUNTS = 0.01, 17


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


class StateFeedback:
    """Gains of a design, used as far as the estimate is trusted; shrinkage: see Tracking.

    While nothing is known the acquisition gain replaces K, and the trajectory excites the backlash.
    u_std: of K (x_hat - x*) for each gain, at least K times half the noise of y. x_std: of |x_hat|.
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
        self.u_std: list[float] = self._least.tolist()
        # |x_hat - x*| that may be noise, so that it is left alone, or worth no crossing.
        self.x_std = self._ignored = self._tolerated = 0.0
        self._knows_x = False  # whether the covariance of x_hat is known
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
        deviation_std, self._knows_x = 0.0, x_cov is not None
        if x_cov is not None:
            of_x_hat = self._design.variances(x_cov)
            of_both = of_x_hat + reference_std**2 * self._design.variances(x_noise)
            stds = np.sqrt(np.maximum(of_both, 0.0))
            self.x_std = max(of_x_hat.item(-1), 0.0)**0.5
            self.u_std, deviation_std = np.maximum(stds[:-1], self._least).tolist(), stds.item(-1)
        # By as much v may rest off: one rule for motion and rest.
        self._ignored = ARRIVED * max(CLOSE * y_std, UNCERTAIN * self.x_std)
        # What noise of the references moves and v did not follow shows as a deviation as well.
        self._tolerated = max(self._ignored, ARRIVED * UNCERTAIN * deviation_std)
        # As hard as leaves what feedback makes of noise below a tenth of the u that the gap takes.
        most = 0.1 * self.gap_u or inf
        self._quiet = next((i for i, std in enumerate(self.u_std) if std <= most),
                           len(self.u_std) - 1)

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
        state, trust, most = self.state, self.trust, self.bounds[0]
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
            astray = off > max(largest, ASTRAY / ARRIVED * self._ignored)
            unproven = SOFTEST - trust.held_for * (SOFTEST + 1) // TRUSTED_AFTER
            self._in_use = max(state.level, unproven, 0 if astray else self._quiet)
            feedback = worth = dot(self._design.schedule[self._in_use], error)
            if self.knows_noise:
                feedback *= 1.0 - self._ignored / max(off, self._ignored)
                worth *= 1.0 - self._tolerated / max(off, self._tolerated)
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
        return self.trust.full and self._knows_x

    @property
    def noise_u(self) -> float:
        """Standard deviation of what feedback makes of noise."""
        return self.u_std[self._quiet]

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
