"""From G to the gains of the tracking structure: a pure function, fit for another process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import hypot

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.tracking.lq_preview import PreviewGains, preview_gains
from backlash_ros.core.control.tracking.margin import Feedback, modulus_margin, tolerates
from backlash_ros.core.control.tracking.reference_window import averages
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction, powers

Array = NDArray[np.float64]
Gain = list[float]

# Times the input weight of feedback: the softer gains are for noise, and up to SOFTEST for the time
# while v meets its limits or the estimate is new; that one while the backlash is unknown.
SCHEDULE = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
SOFTEST = 4
# The same for the ideal trajectory: one that asks for less is moved less by noise of y_m.
SOFTER = (1.0, 1e2, 1e4)
# Times the input weight with which feedback around a better G is tried in turn, until its loop is
# as safe as the one it replaces. The trajectory keeps the weight that was asked for.
SAFER = (1.0, *np.geomspace(1.1, 100.0, 60).tolist())
HORIZON = 300  # samples within which a wrong u must matter, and u* answers to a reference
LOOK_AHEAD = 20  # samples, at most, for which u* is known ahead


@dataclass(frozen=True)
class Weights:
    """What the gains minimise, see `preview_gains`.

    input_weight: rho / |G|^2 at a twentieth of the sampling rate. preview: N [samples].
    """

    input_weight: float
    integral_weight: float
    preview: int


@dataclass(frozen=True)
class Plan:
    """One ideal trajectory.

    states (L, n + 1), references (L, N + 1): u* of the next L samples, of [x*; q*] and the
    references. noise_gains: see ReferenceWindow. x_noise: covariance (n, n) of x* for noise of 1 in
    references, for each of their averages.
    """

    gains: PreviewGains
    states: Array
    references: Array
    noise_gains: Array
    x_noise: tuple[Array, ...]

    def replayed(
        self, model: StateModel, references: Array, history: int,
    ) -> tuple[list[float], float]:
        """x* and q* at the sample of the newest window, from rest at the oldest reference.

        With z = [x*; q*] and u_p = -sum f_j r(k+j) it is z(k+1) = F z(k) + [B; 0] u_p + [0; 1] r.
        history: for how many samples at most.
        """
        n, closed = model.order, _closed(model, self.gains)
        inputs = np.zeros((n + 1, 2))
        inputs[:n, 0], inputs[n, 1] = model.b, 1.0
        by_preview = -np.convolve(references, self.gains.preview[::-1], 'valid')
        steps = len(by_preview) - 1  # the newest one makes the next state
        start = np.append(model.equilibrium * references[0], 0.0)
        z = np.linalg.matrix_power(closed, steps) @ start
        pairs = np.column_stack([by_preview[:steps], references[:steps]])[::-1]
        responses = powers(closed, inputs, max(history, steps))
        z = z + np.einsum('kij,kj->i', responses[:steps], pairs)
        return z[:n].tolist(), float(z[n])


@dataclass(frozen=True)
class TrackingDesign:
    """Gains of one model of G.

    plans: ideal trajectories, each with more weight of u than the one before, for references with
    noise. feedback: of the deviations from them. schedule: gains (n,), that of full feedback first,
    each with less than the one before: see SCHEDULE; where v meets its limits full feedback would
    cycle between them. acquisition: gain (n,) while the backlash is unknown; None where no feedback
    is better. gentle: gain (n,) that leads y back while the reference rests. push: |x| after
    HORIZON samples of u = 1; push_ahead: |y| after LOOK_AHEAD.
    """

    model: StateModel
    plans: tuple[Plan, ...]
    feedback: Feedback
    schedule: tuple[Gain, ...]
    acquisition: Gain | None
    gentle: Gain
    push: float
    push_ahead: float

    def variances(self, x_cov: Array) -> Array:
        """Of K x for every gain of the schedule, and of |x| at last."""
        gains = np.array(self.schedule)
        return np.append(((gains @ x_cov) * gains).sum(axis=1), x_cov.trace())

    @cached_property
    def holding(self) -> tuple[tuple[Array, Array], ...]:
        """For each gain, (L - 1, n) and (L - 1, L): u that it agrees with after it was held.

        Held for j samples from x - x* = e on, u is what u*(k+j) - K (x - x*) asks for then:
        (1 + sum_i K A^i B) u = u*(k+j) + sum_i K A^(j-1-i) B u*(k+i) - K A^j e,  i = 0 .. j - 1
        """
        length = len(self.plans[0].states)
        rows = powers(self.model.a, np.eye(self.model.order), length)
        held = []
        for gain in self.schedule:
            by_state = np.array(gain) @ rows
            answers = np.append(1.0, by_state @ self.model.b)[:length]
            # Without SciPy, which would take a controller 22 MB.
            ago = np.subtract.outer(np.arange(len(answers)), np.arange(length))
            by_u = np.tril(answers[np.maximum(ago, 0)])[1:]
            share = by_u.sum(axis=1)
            count = int(np.cumprod(share > 0.0).sum())  # beyond, it asks for more the more u is
            by_both = np.column_stack([-by_state[1:], by_u])[:count] / share[:count, None]
            held.append((by_both[:, :self.model.order], by_both[:, self.model.order:]))
        return tuple(held)

    @cached_property
    def schedule_sizes(self) -> list[float]:
        """|K| of each."""
        return [hypot(*gain) for gain in self.schedule]


def design(model: StateModel, weights: Weights, weight_factor: float = 1.0) -> TrackingDesign:
    """The gains for a model of G.

    weight_factor: see `feedback_around`. Raises ParameterError where no gains exist.
    """
    # rad per sample, up to which y is corrected while the reference rests
    rest_bandwidth = 1.0 / 80.0
    rho = input_weight(model, weights)
    plans = tuple(
        _plan(model, lq_gains(model, more * rho, weights.integral_weight, weights.preview))
        for more in SOFTER)
    feedback = feedback_around(model, weights, weight_factor)
    schedule = [feedback.gain.tolist(), *(
        lq_gains(model, max(more, weight_factor) * rho).state.tolist() for more in SCHEDULE[1:]
    )]
    # With |G|^2 at a frequency as weight of u^2, feedback acts up to about that frequency.
    gentle = lq_gains(model, power_gain(model.transfer_function, rest_bandwidth)).state
    ahead, later = (powers(model.a, model.b, k).sum(axis=0) for k in (LOOK_AHEAD, HORIZON))
    return TrackingDesign(
        model, plans, feedback, tuple(schedule),
        schedule[SOFTEST] if _bears_wrong_slope(model, SCHEDULE[SOFTEST] * rho) else None,
        gentle.tolist(),
        float(np.linalg.norm(later)), model.c * abs(float(ahead[0])),
    )


def better_design(
    model: StateModel, weights: Weights, present: TrackingDesign,
) -> TrackingDesign | None:
    """Return the design for a better model of G, None where it is no safe replacement.

    It replaces the present one where its loop around the better G keeps a modulus margin that is
    safe in any case, or at least as large as that of the present loop around the G it was made
    for or around the better one; the weight of its input is raised as far as this takes, and no
    further: what is weaker than it has to be is the measure for the next G, and so lost for good.
    A loop that is unstable around the better G is replaced by any stable one; an unstable one
    replaces none.
    """
    needed = 0.5  # no sensitivity above 2
    try:
        for weight_factor in SAFER:
            reached = modulus_margin(model, feedback_around(model, weights, weight_factor))
            if reached < needed and weight_factor == SAFER[0]:
                needed = min(needed, *(
                    modulus_margin(plant, present.feedback) for plant in (present.model, model)
                ))
            if 0.0 < reached >= needed:
                return design(model, weights, weight_factor)
    except ParameterError:
        pass
    return None


def feedback_around(model: StateModel, weights: Weights, weight_factor: float) -> Feedback:
    """Of deviations from the trajectory, as if the input weighed `weight_factor` times as much.

    Raises ParameterError where no gains exist.
    """
    rho = weight_factor * input_weight(model, weights)
    gains = lq_gains(model, rho, weights.integral_weight)
    return Feedback(model, gains.state, gains.integral)


def input_weight(model: StateModel, weights: Weights) -> float:
    """rho of the trajectory."""
    return weights.input_weight * power_gain(model.transfer_function, np.pi / 10.0)


def power_gain(model: TransferFunction, frequency: float) -> float:
    """|G|^2 at so many rad per sample."""
    return float(abs(model.response(np.array([np.exp(1j * frequency)]))[0])) ** 2


# What follows is cached: a controller restarts in the middle of a loop.
@lru_cache(maxsize=64)
def lq_gains(
    model: StateModel, input_weight: float, integral_weight: float = 0.0, window: int = 0,
) -> PreviewGains:
    """The gains of `preview_gains`."""
    return preview_gains(model, input_weight, integral_weight, window)


@lru_cache(maxsize=16)
def _bears_wrong_slope(model: StateModel, input_weight: float) -> bool:
    # Slope, in first guesses. Plants that bear less are led astray by any feedback that would help,
    # and learn faster than they go astray without.
    wrong_slope = 1.35
    return tolerates(Feedback(model, lq_gains(model, input_weight).state), wrong_slope)


def _closed(model: StateModel, gains: PreviewGains) -> Array:
    """Transition of [x*; q*], shape (n + 1, n + 1)."""
    n = model.order
    closed = np.eye(n + 1)
    closed[:n, :n] = model.a - np.outer(model.b, gains.state)
    closed[:n, n] = -gains.integral * model.b
    closed[n, 0] = -model.c
    return closed


def _plan(model: StateModel, gains: PreviewGains) -> Plan:
    """u* of the next samples, of [x*; q*] and of the references, which stay at their last one."""
    n, last = model.order, len(gains.preview) - 1
    length = min(LOOK_AHEAD, last // 3) + 1
    closed = _closed(model, gains)
    k = np.append(gains.state, gains.integral)
    by_state: Array = np.eye(n + 1)  # what makes [x*; q*]
    by_reference: Array = np.zeros((n + 1, last + 1))
    states, references = np.empty((length, n + 1)), np.empty((length, last + 1))
    for j in range(length):
        preview = np.zeros(last + 1)
        preview[j:] = gains.preview[:last + 1 - j]
        preview[last] += gains.preview[last + 1 - j:].sum()
        states[j] = -k @ by_state
        references[j] = -k @ by_reference - preview
        by_reference = np.asarray(closed @ by_reference)
        by_reference[:n] -= np.outer(model.b, preview)
        by_reference[n, min(j, last)] += 1.0
        by_state = closed @ by_state
    # What is ahead rests on references that are not averaged yet as well.
    tail = float(np.linalg.norm(references[:, 2 * last // 3:], axis=1).max())
    u_noise, x_noise = _of_noise(model, gains)
    return Plan(gains, states, references, np.maximum(u_noise, tail), x_noise)


def _of_noise(model: StateModel, gains: PreviewGains) -> tuple[Array, tuple[Array, ...]]:
    """Deviation of u*, covariance of x* for noise of 1 on the references, for their averages."""
    responses = powers(model.a - np.outer(model.b, gains.state), model.b, HORIZON)
    to_u = np.append(1.0, -responses @ gains.state)
    signals = np.column_stack([to_u, np.vstack([np.zeros(model.order), responses])])
    u_noise, x_noise = [], []
    for kernel in averages(len(gains.preview) - 1):
        weights = np.convolve(kernel, gains.preview[::-1])
        of_all = np.array([np.convolve(weights, signal) for signal in signals.T])
        u_noise.append(np.linalg.norm(of_all[0]))
        x_noise.append(of_all[1:] @ of_all[1:].T)
    return np.array(u_noise), tuple(x_noise)
