"""The structure in which y follows y_m: an ideal trajectory and feedback that holds y on it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import isnan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.protocol import Estimate, Status
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.lq_preview import PreviewGains
from backlash_ros.core.rest import OFF, Mode, Rest
from backlash_ros.core.state_model import StateModel
from backlash_ros.core.structure import Command, Situation

Array = NDArray[np.float64]

HARDEN_AFTER = 20  # samples without a limit after which feedback takes a step back to full
WIDENING = 1.03  # per sample, of the bound on feedback while the backlash is unknown
# Samples for which an estimate has to hold before it gets full feedback: one that is confidently
# wrong is contradicted by then. Until then feedback hardens step by step.
TRUSTED_AFTER = 40
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
    While the backlash is unknown, `careful` replaces K, or nothing where it is None: the trajectory
    itself excites the backlash. With the first estimate it gives way to softer gains, then to K.
    caution: standard deviations by which the crossings are shrunk before they are inverted.
    softer: gains to replace K with, step by step, while v meets its limits, where full feedback
    would cycle between them, and while the estimate is new.
    rest: what v does while the trajectory rests. noise_std: of y.
    """

    needs_output = True

    def __init__(
        self, model: StateModel, gains: PreviewGains, careful: Array | None, caution: float,
        rest: Rest, noise_std: float = 0.0, softer: Sequence[Array] = (),
    ) -> None:
        self.delay = len(gains.preview) - 1
        self._model, self._gains = model, gains
        self._careful, self._caution = careful, caution
        self._window: deque[float] = deque(maxlen=self.delay + 1)  # r(k) .. r(k + delay)
        self._x: Array = np.zeros(model.order)  # x* and q* of the trajectory
        self._q = 0.0
        self._integral = 0.0
        self._ideal = 0.0  # u* of the sample before
        self._noise_std, self._u_reach = noise_std, 0.0
        self._trusted_for = 0  # samples
        self._soft = (gains.state, *softer)
        self._level = self._free = 0  # gain in use, samples since v last met a limit
        self._rest = rest

    def go_on_from(self, other: Tracking) -> None:
        """Take over the trajectory of a structure with the same model and preview."""
        self._window, self._x, self._q = other._window, other._x, other._q
        self._integral, self._ideal = other._integral, other._ideal
        self._level, self._free = other._level, other._free
        self._trusted_for, self._u_reach = other._trusted_for, other._u_reach
        self._rest.go_on_from(other._rest)

    def control(self, situation: Situation, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        first = not self._window
        self._take_in(situation)
        gains = self._gains
        window = np.fromiter(self._window, np.float64, self.delay + 1)
        ideal = -float(gains.state @ self._x) - gains.integral * self._q
        ideal -= float(gains.preview @ window)
        deviation = np.zeros(len(self._x)) if first else situation.x_hat - self._x
        trusted = self._is_trusted(situation.estimate, first)
        if self._trusted_for > 0:
            u_d = ideal - float(self._gain(inverse.limited) @ deviation)
        else:
            u_d = ideal - self._careful_feedback(situation.estimate, deviation, ideal)
        if trusted:
            u_d -= gains.integral * (self._integral - self._q)
        before = self._rest.mode
        mode = self._rest.decide(situation, self._window, self._x, ideal, deviation)
        caution = self._caution
        if mode is Mode.FOLLOW:
            inverse.widen_band(self._noise_band(situation, ideal, inverse))
        else:
            if situation.x_cov is not None:
                self._rest.step(situation, ideal, deviation, inverse, mode is not before)
            u_d, caution = self._rest.u_d, self._rest.caution
            inverse.widen_band(0.0)
        self._ideal = ideal
        c_r, c_l = cautious_crossings(situation.estimate, caution)
        v = inverse.step(u_d, situation.estimate.m, c_r, c_l)
        self._advance(ideal, situation.y, trusted, inverse.limited)
        return Command(u_d, v, 0.0)

    def _take_in(self, situation: Situation) -> None:
        if not self._window:
            start, noise = situation.y, OFF * self._noise_std
            # What may be noise is no distance to go: a loop at rest stays at rest.
            near = abs(start - situation.y_m) <= noise
            self._window.extend([situation.y_m if near else start] * (self.delay + 1))
            # No v has acted yet, so nobody knows the state better than rest at y.
            self._x = self._model.equilibrium * self._window[0]
        self._window.append(situation.y_m)

    def _gain(self, limited: bool) -> Array:
        """K, or a softer one: the longer v meets its limits, and the newer the estimate."""
        self._free = 0 if limited else self._free + 1
        if limited:
            self._level = min(self._level + 1, len(self._soft) - 1)
        elif self._level > 0 and self._free % HARDEN_AFTER == 0:
            self._level -= 1
        levels = len(self._soft)
        unproven = levels - 1 - self._trusted_for * levels // TRUSTED_AFTER
        return self._soft[max(self._level, unproven)]

    def _careful_feedback(self, estimate: Estimate, deviation: Array, ideal: float) -> float:
        """Feedback while the backlash is unknown: no larger than the trajectory or the gap asks.

        A wrong slope may make the loop unstable, which bounded feedback slows down. The bound
        widens while it is met: a gap wider than the first guess has to be crossed some day.
        """
        if self._careful is None:
            return 0.0
        self._u_reach = max(
            self._u_reach, abs(ideal), estimate.m * (estimate.c_r - estimate.c_l)
        )
        feedback = float(self._careful @ deviation)
        if abs(feedback) > self._u_reach:
            feedback = self._u_reach if feedback > 0.0 else -self._u_reach
            self._u_reach *= WIDENING
        return feedback

    def _is_trusted(self, estimate: Estimate, first: bool) -> bool:
        # Constants that are given, not learned, are trusted from the start.
        known = TRUSTED_AFTER if first else self._trusted_for
        known += SHARP_COUNTS if _is_sharp(estimate, self._u_reach) else 1
        self._trusted_for = known if _trusted(estimate) else 0
        return self._trusted_for >= TRUSTED_AFTER

    def _noise_band(
        self, situation: Situation, ideal: float, inverse: BacklashInverse,
    ) -> float:
        if situation.x_cov is None:
            return 0.0  # no noise of x enters u_d, a turn is one
        gain = self._gains.state
        variance = float(gain @ situation.x_cov @ gain)
        onward = (ideal - self._ideal) * inverse.side >= 0.0
        return (ONWARD_BAND if onward else NOISE_BAND) * sqrt(max(variance, 0.0))

    def _advance(self, ideal: float, y: float, trusted: bool, limited: bool) -> None:
        r = self._window[0]
        if not trusted:
            self._integral = self._q
        elif not limited:
            # A saturated actuator cannot follow: integrating on would only wind up.
            self._integral += r - y
        self._q += r - self._model.c * float(self._x[0])
        self._x = self._model.a @ self._x + self._model.b * ideal


def _trusted(estimate: Estimate) -> bool:
    # What was learned before a restart says nothing yet about the state of G.
    return estimate.learned and estimate.status not in (Status.ACQUIRING, Status.INCONSISTENT)


def _is_sharp(estimate: Estimate, u_reach: float) -> bool:
    # Beside far larger u even a gap that is hardly known makes little difference.
    large = max(estimate.c_r - estimate.c_l, u_reach / estimate.m)
    std_gap = estimate.std_c_r + estimate.std_c_l
    return estimate.std_m < SHARP * estimate.m and std_gap < SHARP * large


def cautious_crossings(estimate: Estimate, deviations: float) -> tuple[float, float]:
    """Crossings shrunk towards each other by their uncertainty; both 0 while nothing is known.

    Over-compensation drives past the gap and starts a limit cycle, under-compensation only
    leaves a rest of the backlash: in a loop around y the smaller gap is the safe one.
    """
    if deviations == 0.0:
        return estimate.c_r, estimate.c_l
    if isnan(estimate.std_c_r):
        return 0.0, 0.0
    middle = 0.5 * (estimate.c_r + estimate.c_l)
    return (
        max(estimate.c_r - deviations * estimate.std_c_r, middle),
        min(estimate.c_l + deviations * estimate.std_c_l, middle),
    )
