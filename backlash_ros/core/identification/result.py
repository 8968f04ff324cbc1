"""What is compared when an actuator is identified, and what is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.deviations import Response
from backlash_ros.core.identification.structure import Model, Structure
from backlash_ros.core.identification.verdict import Verdict
from backlash_ros.core.plant.actuator import Actuator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """What is compared. delays [samples]: none for EARLY, and later ones where these fit better.
    integrators: of G, without and with one. slope: m, where it is known, else 1: m and the gain of
    G cannot be told apart. held_out: share of the record, its last."""

    orders: Sequence[int] = (0, 1, 2, 3, 4)
    delays: Sequence[int] = ()
    integrators: Sequence[bool] = (False, True)
    slope: float = 1.0
    held_out: float = 1.0 / 3.0


class Compared(NamedTuple):
    """One structure.

    trained: fitted to the first part, with which held_out, the rms of the error on the last part,
    is made; scatter: relative deviation of that. whole: fitted to all samples. criterion: of the
    search, the smaller the better, inf where it was not fitted to the end.
    """

    structure: Structure
    held_out: float
    trained: Model
    whole: Model
    criterion: float = inf
    scatter: float = 0.0


class HeldOut(NamedTuple):
    """Prediction of samples that were not fitted. first: number of the first of them; measured,
    simulated (M,); rms of the error; trained: rms of the fit to the samples before."""

    first: int
    measured: Array
    simulated: Array
    rms: float
    trained: float


class Details(NamedTuple):
    """What pictures show, in units of the record.

    first: number of the first y that was fitted; v, y, p, simulated: of each y from there on, v and
    p as they act on it. profile: gaps (G,), and the rms that G refitted to first order leaves."""

    first: int
    v: Array
    y: Array
    p: Array
    simulated: Array
    response: Response
    compared: tuple[Compared, ...]
    chosen: Compared
    profile: tuple[Array, Array]
    held_out: HeldOut


@dataclass(frozen=True)
class Identification:
    """What was found. u = m (p - c_r), y = z^-delay numerator / denominator u + noise.

    std: deviations of gap, c_r, c_l and, for m, of the product of m and the gain of G. delays: that
    explain y equally well. quantum: step of a quantised y, 0 for none. correlation: of successive
    residuals beyond chance. response_std: relative deviation of G at `frequencies` [rad/sample],
    between which y moves. uncertainty: of G, as the parameter plant.uncertainty. outliers: samples
    of y that were left out. reasons: why it is of no use, remarks: what to know, a sentence each.
    details, verdict: None where nothing was fitted. actuator: between the command and v; None
    where nothing is, or it is not known.
    """

    sample_period: float
    v: Array
    y: Array
    m: float = nan
    gap: float = nan
    c_r: float = nan
    c_l: float = nan
    std: dict[str, float] = field(default_factory=dict)
    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    delay: int = 0
    delays: tuple[int, ...] = ()
    integrator: bool = False
    noise_std: float = nan
    quantum: float = 0.0
    correlation: float = nan
    frequencies: Array = field(default_factory=lambda: np.empty(0))
    response_std: Array = field(default_factory=lambda: np.empty(0))
    uncertainty: float = nan
    outliers: int = 0
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    details: Details | None = None
    verdict: Verdict | None = None
    actuator: Actuator | None = None

    @property
    def usable(self) -> bool:
        """Whether it may be put into the controller."""
        return not self.reasons
