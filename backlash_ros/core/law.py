"""What every law offers: estimates of the backlash, the state of G, and a report of its work."""

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
    """What the controller did between two samples: v was applied, y_m and u_d led to it."""

    v: float
    y_m: float
    u_d: float
    other: float = nan  # v that may have been applied instead, nan for no doubt


class OutOfBounds(NamedTuple):
    """A quantity, as its bound is named, that was found beyond it."""

    name: str
    value: float
    bound: tuple[float, float]


@dataclass(frozen=True)
class LawReport:
    """What a law knows of its own work; the defaults are those of a law that does not learn it."""

    noise_ratio: float = nan  # standard deviation of the noise on y, over the configured one
    unexplained: float = nan  # motion of u that no backlash and no G explains, over m times the gap
    coasts: bool = False  # whether no estimate is better because the load runs on within the gap
    unconfirmed: bool = False  # whether samples do not confirm yet what was known before the run
    wrong_sign: bool = False  # whether there is no estimate because y moves against v
    undecided: bool = False  # whether there is none as several gaps explain y alike
    forbidden: OutOfBounds | None = None  # what keeps a good estimate from being published
    waiting: int = 0  # samples that no fit has taken in yet
    overdue: int = 0  # samples since the fit that is under way was due
    outliers: int = 0  # readings rejected so far
    reattributed: int = 0  # intervals so far over which another v acted than the one commanded
    failed_fits: int = 0  # fits so far without a result


class Law:
    """Learns (m, c_r, c_l), and f where it adapts it, from v and y alone.

    Laws inherit from here what they do not do themselves.
    """

    RETUNED: ClassVar[tuple[str, ...]] = ()  # names of the parameters that `retune` takes up
    estimate: Estimate
    adapting: bool = True  # whether it learns; otherwise it follows the state of G alone

    @property
    def x_hat(self) -> Sequence[float] | Array:
        """State of G given y(..k) in the coordinates of StateModel, shape (n,); () without one."""
        return ()

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None where there is none."""
        return None

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and what was applied from k-1 to k."""

    def refine(self) -> None:
        """Do what the command of this sample need not wait for."""

    @property
    def u_hat(self) -> float:
        """Newest reconstruction of u; nan where there is none."""
        return nan

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction from the samples before; nan where y(k) was lost."""
        return nan

    @property
    def learned_model(self) -> StateModel | None:
        """The G behind the newest estimate; None for a law that learns no G."""
        return None

    @property
    def proposal(self) -> StateModel | None:
        """A better G than that of x_hat, of whatever order; None if none is new."""
        return None

    def adopt(self, model: StateModel) -> None:
        """Give x_hat in the coordinates of this model from now on."""

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        """Relative deviation of the response of `learned_model` at z (M,), nan for none."""
        return np.full(len(z), nan)

    @property
    def report(self) -> LawReport:
        return LawReport()

    def retune(self, p: Parameters) -> None:
        """Take up new values of the parameters RETUNED; what was learned stays."""

    def close(self) -> None:
        """Give back what it holds elsewhere: its record in a worker, and a fit under way."""
