"""From G to the gains of the tracking structure, in pieces that fit between two samples."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.lq_preview import PreviewGains, preview_gains
from backlash_ros.core.slope_tolerance import tolerates
from backlash_ros.core.state_model import StateModel
from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

# Times the input weight while v meets its limits or the estimate is new; the last one while the
# backlash is unknown.
SOFTER = (1e1, 1e2, 1e3, 1e4)
# Slope, in first guesses, that this last one has to bear to be used at all. Plants that bear less
# are led astray by any feedback that would help, and learn faster than they go astray without.
WRONG_SLOPE = 1.35
REST_BANDWIDTH = 1.0 / 80.0  # rad per sample, up to which y is corrected while the reference rests


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

    softer: gains (n,) to replace that of the state with, step by step, while v meets its limits,
    where full feedback would cycle between them, and while the estimate is new.
    careful: gain (n,) while the backlash is unknown; None where no feedback is better.
    gentle: gain (n,) that leads y back while the reference rests.
    """

    model: StateModel
    gains: PreviewGains
    softer: tuple[Array, ...]
    careful: Array | None
    gentle: Array


def design_in_pieces(
    model: StateModel, weights: Weights,
) -> Generator[None, None, TrackingDesign]:
    """Return the design; stops after each Riccati equation.

    Raises ParameterError where no gains exist.
    """
    rho = weights.input_weight * power_gain(model.transfer_function, np.pi / 10.0)
    gains = lq_gains(model, rho, weights.integral_weight, weights.preview)
    yield
    softer = []
    for more in SOFTER:
        softer.append(lq_gains(model, more * rho).state)
        yield
    bears_wrong_slope = _bears_wrong_slope(model, SOFTER[-1] * rho)
    yield
    # With |G|^2 at a frequency as weight of u^2, feedback acts up to about that frequency.
    gentle = lq_gains(model, power_gain(model.transfer_function, REST_BANDWIDTH)).state
    return TrackingDesign(
        model, gains, tuple(softer), softer[-1] if bears_wrong_slope else None, gentle
    )


def design(model: StateModel, weights: Weights) -> TrackingDesign:
    """The same at once."""
    pieces = design_in_pieces(model, weights)
    while True:
        try:
            next(pieces)
        except StopIteration as done:
            finished: TrackingDesign = done.value
            return finished


def power_gain(model: TransferFunction, frequency: float) -> float:
    """|G|^2 at so many rad per sample."""
    return float(abs(model.response(np.array([np.exp(1j * frequency)]))[0])) ** 2


# What follows is remembered: a controller that begins anew does so in the middle of a loop.
@lru_cache(maxsize=64)
def lq_gains(
    model: StateModel, input_weight: float, integral_weight: float = 0.0, window: int = 0,
) -> PreviewGains:
    """The gains of `preview_gains`."""
    return preview_gains(model, input_weight, integral_weight, window)


@lru_cache(maxsize=16)
def _bears_wrong_slope(model: StateModel, input_weight: float) -> bool:
    return tolerates(model, lq_gains(model, input_weight).state, WRONG_SLOPE)
