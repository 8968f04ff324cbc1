"""The structure in which y follows y_m: an ideal trajectory and feedback that holds y on it."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, sqrt
from operator import sub

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.protocol import Estimate, Status
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.reference_window import ReferenceWindow
from backlash_ros.core.rest import OFF, Mode, Rest
from backlash_ros.core.structure import Command, Situation, dot
from backlash_ros.core.tracking_design import TrackingDesign, Weights

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
    While the backlash is unknown, the careful gain of the design replaces K: the trajectory itself
    excites the backlash. With the first estimate it gives way to softer gains, then to K.
    caution: standard deviations by which the crossings are shrunk before they are inverted.
    noise_std: of y.

    x_cov is only looked into when it is another array than the sample before.
    """

    needs_output = True

    def __init__(
        self, design: TrackingDesign, weights: Weights, caution: float, noise_std: float = 0.0,
    ) -> None:
        self.delay = weights.preview
        self._weights, self._caution, self._noise_std = weights, caution, noise_std
        self._references = ReferenceWindow(self.delay, design.model.memory)
        self._rest = Rest(design.model, design.gentle, noise_std)
        self._use(design)
        self._x = [0.0] * design.model.order  # x* and q* of the trajectory
        self._q = 0.0
        self._integral = 0.0
        self._ideal = 0.0  # u* of the sample before
        self._u_reach = 0.0
        self._trusted_for = 0  # samples
        self._level = self._free = 0  # gain in use, samples since v last met a limit

    def _use(self, design: TrackingDesign) -> None:
        model, gains = design.model, design.gains
        self._design = design
        self._a: list[list[float]] = model.a.tolist()
        self._b: list[float] = model.b.tolist()
        self._k: list[float] = gains.state.tolist()
        self._soft: list[list[float]] = [gain.tolist() for gain in (gains.state, *design.softer)]
        self._careful = None if design.careful is None else design.careful.tolist()
        self._x_cov: Array | None = None
        self._x_std = self._feedback_std = 0.0  # of x_hat and of K x_hat, as in x_cov

    def go_on_from(self, other: Tracking) -> None:
        """Take over the trajectory of a structure with the same model and preview."""
        self._references, self._x, self._q = other._references, other._x, other._q
        self._integral, self._ideal = other._integral, other._ideal
        self._level, self._free = other._level, other._free
        self._trusted_for, self._u_reach = other._trusted_for, other._u_reach
        self._rest.go_on_from(other._rest)

    def control(self, situation: Situation, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        estimate, gains = situation.estimate, self._design.gains
        first = self._references.empty
        if first:
            self._begin(situation)
        window = self._references.append(situation.y_m)
        x = self._x
        ideal = -dot(self._k, x) - float(gains.preview.dot(window))
        if gains.integral:
            ideal -= gains.integral * self._q
        onward = [dot(row, x) + b * ideal for row, b in zip(self._a, self._b, strict=True)]
        deviation = [0.0] * len(x) if first else list(map(sub, situation.x_hat, x))
        x_cov = situation.x_cov
        if x_cov is not self._x_cov:
            self._note_covariance(x_cov)
        trusted = self._is_trusted(estimate, first)
        if self._trusted_for > 0:
            u_d = ideal - dot(self._gain(inverse.limited), deviation)
        else:
            u_d = ideal - self._careful_feedback(estimate, deviation, ideal)
        if trusted and gains.integral:
            u_d -= gains.integral * (self._integral - self._q)
        rest = self._rest
        before = rest.mode
        mode = rest.decide(
            situation.y, window, x, onward, deviation, None if x_cov is None else self._x_std
        )
        caution = self._caution
        if mode is Mode.FOLLOW:
            inverse.widen_band(self._noise_band(ideal, inverse))
        else:
            if x_cov is not None:
                rest.step(estimate, ideal, deviation, inverse, mode is not before)
            elif before is Mode.FOLLOW:
                rest.stay(ideal)
            u_d, caution = rest.u_d, rest.caution
            inverse.widen_band(0.0)
        self._ideal, self._x = ideal, onward
        c_r, c_l = cautious_crossings(estimate, caution)
        v = inverse.step(u_d, estimate.m, c_r, c_l)
        if gains.integral:
            self._integrate(window.item(0), situation.y, x[0], trusted, inverse.limited)
        return Command(u_d, v, 0.0)

    def _begin(self, situation: Situation) -> None:
        start, noise = situation.y, OFF * self._noise_std
        # What may be noise is no distance to go: a loop at rest stays at rest.
        near = abs(start - situation.y_m) <= noise
        r = situation.y_m if near else start
        self._references.fill(r)
        # No v has acted yet, so nobody knows the state better than rest at y.
        self._x = (self._design.model.equilibrium * r).tolist()

    def _gain(self, limited: bool) -> list[float]:
        """K, or a softer one: the longer v meets its limits, and the newer the estimate."""
        self._free = 0 if limited else self._free + 1
        if limited:
            self._level = min(self._level + 1, len(self._soft) - 1)
        elif self._level > 0 and self._free % HARDEN_AFTER == 0:
            self._level -= 1
        levels = len(self._soft)
        unproven = levels - 1 - self._trusted_for * levels // TRUSTED_AFTER
        return self._soft[max(self._level, unproven)]

    def _careful_feedback(
        self, estimate: Estimate, deviation: Sequence[float], ideal: float,
    ) -> float:
        """Feedback while the backlash is unknown: no larger than the trajectory or the gap asks.

        A wrong slope may make the loop unstable, which bounded feedback slows down. The bound
        widens while it is met: a gap wider than the first guess has to be crossed some day.
        """
        if self._careful is None:
            return 0.0
        self._u_reach = max(
            self._u_reach, abs(ideal), estimate.m * (estimate.c_r - estimate.c_l)
        )
        feedback = dot(self._careful, deviation)
        if abs(feedback) > self._u_reach:
            feedback = self._u_reach if feedback > 0.0 else -self._u_reach
            self._u_reach *= WIDENING
        return feedback

    def _is_trusted(self, estimate: Estimate, first: bool) -> bool:
        """Whether the estimate gets full feedback; counts the samples for which it has held."""
        if not _trusted(estimate):
            self._trusted_for = 0
            return False
        if first:
            self._trusted_for = TRUSTED_AFTER
        if self._trusted_for < TRUSTED_AFTER:
            self._trusted_for += SHARP_COUNTS if _is_sharp(estimate, self._u_reach) else 1
        return self._trusted_for >= TRUSTED_AFTER

    def _note_covariance(self, x_cov: Array | None) -> None:
        self._x_cov = x_cov
        if x_cov is None:
            self._x_std = self._feedback_std = 0.0
            return
        rows: list[list[float]] = x_cov.tolist()
        variance = dot(self._k, [dot(row, self._k) for row in rows])
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
