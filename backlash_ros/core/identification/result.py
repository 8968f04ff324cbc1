"""What is compared when an actuator is identified, and what is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
    p as they act on it."""

    first: int
    v: Array
    y: Array
    p: Array
    simulated: Array
    response: Response
    held_out: HeldOut


class FoundModel(NamedTuple):
    """y = z^-delay numerator / denominator u, for the m that was told, and how surely it is known.

    delays: that explain y equally well. response_std: relative deviation of G at `frequencies`
    [rad/sample], between which y moves. uncertainty: of G, as the parameter plant.uncertainty.
    """

    numerator: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    delay: int = 0
    delays: tuple[int, ...] = ()
    integrator: bool = False
    frequencies: Array = np.empty(0)
    response_std: Array = np.empty(0)
    uncertainty: float = nan


class Noise(NamedTuple):
    """Of y. std: deviation. quantum: step of a quantised y, 0 for none. correlation: of successive
    residuals beyond chance. outliers: samples that were left out."""

    std: float = nan
    quantum: float = 0.0
    correlation: float = nan
    outliers: int = 0


@dataclass(frozen=True)
class Identification:
    """What was found. u = m (p - c_r), y = G u + noise.

    m: as it was told. std: deviations of gap, c_r, c_l and, for m, of the product of m and the gain
    of G. refused: why nothing was fitted, or why a controller does not take it. details, verdict:
    None where nothing was fitted. actuator: between the command and v; None where nothing is, or it
    is not known.
    """

    sample_period: float
    v: Array
    y: Array
    m: float = nan
    gap: float = nan
    c_r: float = nan
    std: dict[str, float] = field(default_factory=dict)
    model: FoundModel = field(default_factory=FoundModel)
    noise: Noise = field(default_factory=Noise)
    refused: str = ''
    fit: tuple[Details, Verdict] | None = None
    actuator: Actuator | None = None

    @property
    def c_l(self) -> float:
        """Left crossing."""
        return self.c_r - self.gap

    @property
    def details(self) -> Details | None:
        """What pictures show."""
        return self.fit and self.fit[0]

    @property
    def verdict(self) -> Verdict | None:
        """What is known."""
        return self.fit and self.fit[1]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is of no use to a controller, a sentence each."""
        return (self.refused,) if self.refused else self.verdict.reasons if self.verdict else ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know, a sentence each."""
        return self.verdict.remarks if self.verdict else ()

    def with_remarks(self, remarks: Sequence[str]) -> Identification:
        """The same with these remarks, where something was fitted."""
        if self.fit is None:
            return self
        return replace(self, fit=(self.fit[0], self.fit[1]._replace(remarks=tuple(remarks))))

    @property
    def usable(self) -> bool:
        """Whether it may be put into the controller."""
        return not self.reasons
