"""The interface of every law: estimates of the backlash, the state of G, a report on its work."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import Array, StateModel


class Interval(NamedTuple):
    """What the controller applied from sample to sample: v, and the y_m and u_d that led to it."""

    v: float
    y_m: float
    u_d: float
    other: float = nan  # v that may have acted instead, nan if there is no doubt


class OutOfBounds(NamedTuple):
    """An estimate outside its bounds: name of the bound, estimated value, bounds."""

    name: str
    value: float
    bound: tuple[float, float]


@dataclass(frozen=True)
class LawReport:
    """A law's report on its own work; the defaults are for laws that cannot tell."""

    noise_ratio: float = nan  # learned over configured std of the noise on y
    unexplained: float = nan  # unexplained motion of u over m times the gap
    coasts: bool = False  # whether the load coasts in the gap, which spoils estimates
    unconfirmed: bool = False  # whether newer samples do not confirm the estimate that holds
    wrong_sign: bool = False  # whether y moves against v, so that there is no estimate
    reversals: float = nan  # of the load, by a fit that does not yet count as known
    forbidden: OutOfBounds | None = None  # bound that keeps a good estimate from being published
    waiting: int = 0  # samples that no fit includes yet
    overdue: int = 0  # samples since the fit under way was due
    outliers: int = 0  # readings rejected so far
    reattributed: int = 0  # times so far that another v than commanded was found to have acted
    failed_fits: int = 0  # fits so far without a result


class Law:
    """Base class: learns (m, c_r, c_l), and f if the law adapts it, from v and y alone.

    The methods here are defaults for laws without that capability.
    """

    RETUNED: ClassVar[tuple[str, ...]] = ()  # names of the parameters that `retune` updates
    estimate: Estimate
    adapting: bool = True  # whether it learns, or only tracks the state of G

    @property
    def x_hat(self) -> Sequence[float]:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,); () without one."""
        return ()

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None if not known."""
        return None

    def update(self, y: float | None, interval: Interval) -> None:
        """Process y(k), None if it was lost, and what was applied from k-1 to k."""

    def prepare(self) -> None:
        """Do the work for the next update that the command of this sample need not wait for."""

    def refine(self) -> None:
        """Begin or take up work that takes longer than a sample."""

    @property
    def u_hat(self) -> float:
        """Newest reconstruction of u; nan if there is none."""
        return nan

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction from the samples before; nan if y(k) was lost."""
        return nan

    @property
    def learned_model(self) -> StateModel | None:
        """The G that belongs to the newest estimate; None for a law that does not learn G."""
        return None

    @property
    def proposal(self) -> StateModel | None:
        """A better G than that of x_hat, possibly of another order; None if there is no new one."""
        return None

    def adopt(self, model: StateModel) -> None:
        """Use this model from now on: x_hat is in its coordinates."""

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        """Relative std of the response of `learned_model` at z (M,), nan if not known."""
        return np.full(len(z), nan)

    @property
    def report(self) -> LawReport:
        return LawReport()

    def retune(self, p: Parameters) -> None:
        """Apply new values of the parameters in RETUNED; what was learned is kept."""

    def close(self) -> None:
        """Release its resources: a fit under way in a worker is dropped."""
