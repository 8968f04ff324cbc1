"""From G to the gains of the tracking structure, in pieces that fit between two samples."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import lru_cache
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.tracking.lq_preview import PreviewGains, preview_gains
from backlash_ros.core.control.tracking.slope_tolerance import Feedback, margin_in_pieces, tolerates
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

# Times the input weight of the feedback while v meets its limits or the estimate is new; the last
# one while the backlash is unknown.
SCHEDULE = (1e1, 1e2, 1e3, 1e4)
# Times the input weight with which feedback around a better G is tried in turn until its loop is
# as safe as the one it replaces. The trajectory keeps the weight that was asked for.
SAFER = (1.0, 1.1, 1.4, 2.0, 4.0, 10.0, 30.0, 100.0)
HALVINGS = 6  # of the ratio between the last weight that was not safe and the first one that is
# Slope, in first guesses, that this last one has to bear to be used at all. Plants that bear less
# are led astray by any feedback that would help, and learn faster than they go astray without.
WRONG_SLOPE = 1.35
REST_BANDWIDTH = 1.0 / 80.0  # rad per sample, up to which y is corrected while the reference rests
REST_HORIZON = 300  # samples within which a wrong u at rest must matter to be worth a step
SAFE_MARGIN = 0.5  # modulus margin that is safe in any case: no sensitivity above 2


@dataclass(frozen=True)
class Weights:
    """What the gains minimise, see `preview_gains`.

    input_weight: rho / |G|^2 at a twentieth of the sampling rate. preview: N [samples].
    """

    input_weight: float
    integral_weight: float
    preview: int


@dataclass(frozen=True)
class TrackingDesign:
    """Gains of one model of G.

    gains: of the ideal trajectory. feedback: of the deviations from it. schedule: gains (n,), each
    with less feedback than the one before, for the time while v meets its limits, where full
    feedback would cycle between them, and while the estimate is new.
    acquisition: gain (n,) while the backlash is unknown; None where no feedback is better.
    gentle: gain (n,) that leads y back while the reference rests. push: |x| after REST_HORIZON
    samples of u = 1.
    """

    model: StateModel
    gains: PreviewGains
    feedback: Feedback
    schedule: tuple[Array, ...]
    acquisition: Array | None
    gentle: Array
    push: float


def design_in_pieces(
    model: StateModel, weights: Weights, weight_factor: float = 1.0,
) -> Generator[None, None, TrackingDesign]:
    """Return the design; stops after each Riccati equation.

    weight_factor: see `feedback_around`. Raises ParameterError where no gains exist.
    """
    rho = input_weight(model, weights)
    gains = lq_gains(model, rho, weights.integral_weight, weights.preview)
    yield
    feedback = feedback_around(model, weights, weight_factor)
    yield
    schedule = []
    for more in SCHEDULE:
        schedule.append(lq_gains(model, max(more, weight_factor) * rho).state)
        yield
    bears_wrong_slope = _bears_wrong_slope(model, SCHEDULE[-1] * rho)
    yield
    # With |G|^2 at a frequency as weight of u^2, feedback acts up to about that frequency.
    gentle = lq_gains(model, power_gain(model.transfer_function, REST_BANDWIDTH)).state
    yield
    push = float(np.linalg.norm(powers(model.a, model.b, REST_HORIZON).sum(axis=0)))
    acquisition = schedule[-1] if bears_wrong_slope else None
    return TrackingDesign(model, gains, feedback, tuple(schedule), acquisition, gentle, push)


def better_design_in_pieces(
    model: StateModel, weights: Weights, present: TrackingDesign,
) -> Generator[None, None, TrackingDesign | None]:
    """Return the design for a better model of G, None where it is no safe replacement.

    It replaces the present one where its loop around the better G keeps a modulus margin that is
    usual (SAFE_MARGIN), or at least as large as that of the present loop around the G it was made
    for or around the better one; the weight of its input is raised as far as this takes. A loop
    that is unstable around the better G is replaced by any stable one; an unstable one replaces
    none.
    """
    needed = SAFE_MARGIN
    compared = False
    unsafe = 0.0
    for weight_factor in SAFER:
        try:
            margin = yield from _margin_with(model, weights, weight_factor)
        except ParameterError:
            return None
        if margin < needed and not compared:
            compared = True
            for plant in (present.model, model):
                theirs = yield from margin_in_pieces(plant, present.feedback)
                needed = min(needed, theirs)
        if margin > 0.0 and margin >= needed:
            break
        unsafe = weight_factor
    else:
        return None
    # What is weaker than it has to be is the measure for the next G, and so lost for good.
    for _ in range(HALVINGS if unsafe > 0.0 else 0):
        between = sqrt(unsafe * weight_factor)
        margin = yield from _margin_with(model, weights, between)
        if margin > 0.0 and margin >= needed:
            weight_factor = between
        else:
            unsafe = between
    return (yield from design_in_pieces(model, weights, weight_factor))


def _margin_with(
    model: StateModel, weights: Weights, weight_factor: float,
) -> Generator[None, None, float]:
    """Modulus margin of the loop around G with this weight; raises ParameterError."""
    feedback = feedback_around(model, weights, weight_factor)
    yield
    return (yield from margin_in_pieces(model, feedback))


def design(model: StateModel, weights: Weights) -> TrackingDesign:
    """The same at once."""
    pieces = design_in_pieces(model, weights)
    while True:
        try:
            next(pieces)
        except StopIteration as done:
            finished: TrackingDesign = done.value
            return finished


class Replay:
    """The trajectory of a design for references that have passed.

    With z = [x*; q*] and u_p = -sum f_j r(k+j) it is z(k+1) = F z(k) + [B; 0] u_p(k) + [0; 1] r(k).
    history: for how many samples at most.
    """

    def __init__(self, design: TrackingDesign, history: int) -> None:
        self._design = design
        model, gains, n = design.model, design.gains, design.model.order
        self._transition = np.eye(n + 1)
        self._transition[:n, :n] = model.a - np.outer(model.b, gains.state)
        self._transition[:n, n] = -gains.integral * model.b
        self._transition[n, 0] = -model.c
        inputs = np.zeros((n + 1, 2))
        inputs[:n, 0], inputs[n, 1] = model.b, 1.0
        self._responses = powers(self._transition, inputs, history)

    def state(self, references: Array) -> tuple[list[float], float]:
        """x* and q* at the sample of the newest window, from rest at the oldest reference."""
        design, n = self._design, self._design.model.order
        by_preview = -np.convolve(references, design.gains.preview[::-1], 'valid')
        steps = len(by_preview) - 1  # the newest one makes the next state
        start = np.append(design.model.equilibrium * references[0], 0.0)
        z = np.linalg.matrix_power(self._transition, steps) @ start
        inputs = np.column_stack([by_preview[:steps], references[:steps]])[::-1]
        z = z + np.einsum('kij,kj->i', self._responses[:steps], inputs)
        return z[:n].tolist(), float(z[n])


def powers(a: Array, b: Array, count: int) -> Array:
    """b, a b, a^2 b, ... for a (n, n) and b (n,) or (n, m), stacked `count` high."""
    stack, factor = b[None], a
    while len(stack) < count:
        stack = np.concatenate([stack, factor @ stack if b.ndim > 1 else stack @ factor.T])
        factor = factor @ factor
    return stack[:count]


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
    return tolerates(model, lq_gains(model, input_weight).state, WRONG_SLOPE)
