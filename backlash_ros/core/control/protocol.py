"""What every structure offers: it turns y_m into u_d and v."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import StateSource
from backlash_ros.core.plant.transfer_function import StateModel

# Largest feedback, whatever y does, in units of the u that the reference has asked for so far or
# that the gap takes: while the backlash is unknown, as wrong as a first guess may be; later what
# leads y back from where it has gone until then.
LARGEST_IN_ACQUISITION, LARGEST_FEEDBACK = 10.0, 100.0


class ControlInput(NamedTuple):
    """What is known at a sample."""

    y_m: float
    y: float
    estimate: Estimate
    source: StateSource
    crossing: float = 0.0  # samples that v takes across the gap, by its limits


class Command(NamedTuple):
    """Desired input u_d of G, the control v that shall cause it, and the gain f in use."""

    u_d: float
    v: float
    f: float


class ControlStructure:
    """Makes u_d from the reference and drives the inverse with it.

    Structures inherit from here what a better G does not change.
    """

    delay: int = 0  # samples by which y is meant to follow y_m

    @property
    def may_change(self) -> bool:
        """Whether gains for a better G may take over at this sample."""
        return True

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return the command of this sample; advances the inverse by one step."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Do what the next command need not wait for; the next one does it where nobody asks."""

    def redesign(self, model: StateModel) -> Callable[[], object | None] | None:
        """What makes gains for a better G in any process, or None if unsafe; None: none to make."""
        return None

    def adopt(self, gains: object, source: StateSource) -> None:
        """Use such gains from the next sample on, without a jump of v; source: of their x_hat."""

    def go_on_from(self, other: ControlStructure, state_known: bool = True) -> None:
        """Take over v from another structure; state_known: whether x_hat still says where G is."""
