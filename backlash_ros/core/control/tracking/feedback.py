"""Feedback that holds x on the ideal trajectory: K (x_hat - x*) + K_q (q - q*), within bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt
from operator import sub

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.protocol import LARGEST_FEEDBACK, LARGEST_IN_ACQUISITION, dot
from backlash_ros.core.control.tracking.design import TrackingDesign
from backlash_ros.core.control.tracking.rest import TOLERANCE
from backlash_ros.core.control.tracking.trust import Trust
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.plant.noise_level import NoiseLevel

Array = NDArray[np.float64]

STIFFEN_AFTER = 20  # samples without a limit after which feedback takes a step back to full
LEAST_NOISE = 0.5  # of x_hat, in units of the noise on y, that may always be in it
WIDENING = 1.03  # per sample, of the bound on feedback while the backlash is unknown


@dataclass
class FeedbackState:
    """What feedback remembers.

    integral: q - q*. level, free: place in the schedule while v does not follow, and samples since
    it does again. bounded: whether feedback met its bound the sample before. width: bound in scales
    while the backlash is unknown. asked: largest |u*| so far. blind_for: samples from now on in
    which x_hat cannot be known.
    """

    integral: float = 0.0
    level: int = 0
    free: int = 0
    bounded: bool = False
    width: float = 1.0
    asked: float = 0.0
    blind_for: int = 1


class StateFeedback:
    """Gains of a design, used as far as the estimate is trusted.

    While nothing is known the acquisition gain replaces K, and the trajectory itself excites the
    backlash. From the first estimate on the gains are those of the schedule, up to K. noise_std:
    of y.
    """

    def __init__(self, design: TrackingDesign, trust: Trust, noise_std: float) -> None:
        self.state = FeedbackState()
        self._trust, self._noise_std = trust, noise_std
        self._scale = 0.0  # largest |u*| so far, or the u that the gap takes
        self.use(design)

    def use(self, design: TrackingDesign) -> None:
        """Use these gains."""
        gain = design.feedback.gain
        self._integral_gain = design.feedback.integral
        self._schedule: list[list[float]] = [g.tolist() for g in (gain, *design.schedule)]
        # What an error of y calls for that would not matter at rest: never too much feedback.
        by_noise = self._noise_std * float(np.linalg.norm(gain))
        self._tolerated, self._least_noise = TOLERANCE * by_noise, LEAST_NOISE * by_noise
        self._acquisition = None if design.acquisition is None else design.acquisition.tolist()
        self._level = NoiseLevel()
        self._x_cov: Array | None = None
        self.x_std = self._u_std = 0.0  # deviations of x_hat and of K x_hat

    def go_on_from(self, other: StateFeedback, state_known: bool) -> None:
        """Go on where another one is."""
        self.state = replace(other.state)
        if not state_known:
            self.state = replace(self.state, width=1.0, asked=0.0, bounded=False,
                                 blind_for=len(self._schedule[0]))

    def deviation(self, x_hat: Sequence[float], x: Sequence[float]) -> list[float]:
        """x_hat - x*; 0 while x_hat cannot be known."""
        if self.state.blind_for:
            self.state.blind_for -= 1
            return [0.0] * len(x)
        return list(map(sub, x_hat, x))

    def take_covariance(self, x_cov: Array | None) -> None:
        """Take in the covariance of x_hat; looked into when it is another array than before."""
        if x_cov is self._x_cov:
            return
        self._x_cov = x_cov
        if x_cov is None:
            self.x_std = self._u_std = 0.0
            return
        rows: list[list[float]] = x_cov.tolist()
        gain = self._schedule[0]
        self._u_std = sqrt(max(dot(gain, [dot(row, gain) for row in rows]), 0.0))
        self.x_std = sqrt(max(sum(row[i] for i, row in enumerate(rows)), 0.0))

    @property
    def noise(self) -> float:
        """Standard deviation of what full feedback makes of noise.

        As the covariance of x_hat says; as feedback itself shows, where the noise of y is told
        wrongly; and at least for errors of y beside its noise.
        """
        return max(self._u_std, self._level.std, self._least_noise)

    def ask(self, ideal: float, estimate: Estimate) -> None:
        """Note what the trajectory asks for at this sample: the scale of what is allowed."""
        self.state.asked = max(self.state.asked, abs(ideal))
        self._scale = max(self.state.asked, estimate.m * (estimate.c_r - estimate.c_l))

    def u(self, deviation: Sequence[float], held_back: bool) -> float:
        """What is taken from u*.

        held_back: whether v met its limits, or is on its way across the gap.
        """
        state, trust = self.state, self._trust
        if trust.begun:
            feedback = dot(self._gain(held_back or state.bounded), deviation)
            self._level.take(feedback)
        else:
            feedback = self._in_acquisition(deviation)
            if abs(feedback) == self.acquisition_bound:
                # A gap wider than the first guess has to be crossed some day.
                state.width = min(WIDENING * state.width, LARGEST_IN_ACQUISITION)
        if trust.full:
            feedback += self._integral_gain * state.integral
        state.bounded = not -self.most <= feedback <= self.most
        if state.bounded:
            feedback = min(max(feedback, -self.most), self.most) if feedback == feedback else 0.0
        return feedback

    def peek(self, deviation: Sequence[float]) -> float:
        """The same, which changes nothing."""
        before = self.state
        self.state = replace(before)
        feedback = self.u(deviation, held_back=False)
        self.state = before
        return feedback

    def integrate(self, difference: float, limited: bool) -> None:
        """Take in y* - y; a saturated actuator cannot follow: going on would only wind up."""
        if not self._trust.full:
            self.state.integral = 0.0
        elif not (limited or self.state.bounded):
            self.state.integral += difference

    @property
    def most(self) -> float:
        """Largest feedback once an estimate is known."""
        return LARGEST_FEEDBACK * max(self._scale, self._tolerated)

    @property
    def reach(self) -> float:
        """Largest |u_d - u*|, whatever makes u_d."""
        return self.most if self._trust.begun else LARGEST_IN_ACQUISITION * self._scale

    @property
    def acquisition_bound(self) -> float:
        """Largest feedback while the backlash is unknown.

        A wrong slope may make the loop unstable, which bounded feedback slows down.
        """
        return self.state.width * self._scale

    def _in_acquisition(self, deviation: Sequence[float]) -> float:
        if self._acquisition is None:
            return 0.0
        bound = self.acquisition_bound
        return min(max(dot(self._acquisition, deviation), -bound), bound)

    def _gain(self, held_back: bool) -> list[float]:
        """K, or the less of it the longer v does not follow, and the newer the estimate."""
        state, levels = self.state, len(self._schedule)
        state.free = 0 if held_back else state.free + 1
        if held_back:
            state.level = min(state.level + 1, levels - 1)
        elif state.level > 0 and state.free % STIFFEN_AFTER == 0:
            state.level -= 1
        unproven = levels - 1 - self._trust.share(levels)
        return self._schedule[max(state.level, unproven)]
