"""How a better G reaches the gains: designed beside the loop, used when v may take a change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from backlash_ros.core.control.protocol import ControlStructure
from backlash_ros.core.control.serial_plant import SerialPlant
from backlash_ros.core.jobs import LOST, Channel, Executor, Failure
from backlash_ros.core.plant.transfer_function import StateModel

# Samples after which a better design takes over though v crosses the gap: an unstable loop never
# stops to.
LONGEST_WAIT = 200


class Design(NamedTuple):
    """model: a better G. commanded: that, with the motor in front. gains: None for the present."""

    model: StateModel
    commanded: StateModel
    gains: object | None = None


@dataclass
class Redesign:
    """Has gains made for the better models of G that the estimator proposes, one at a time.

    adopted: the learned G that is in use. considered: the proposal that was designed for last.
    failed: designs without a result. waited: samples for which gains that are made could not take
    over.
    """

    executor: Executor
    adopted: StateModel | None = None
    considered: StateModel | None = None
    failed: int = 0
    _channel: Channel | None = None  # from the first design on
    _design: Design | None = None
    _made: bool = False
    _waited: int = 0

    @property
    def busy(self) -> bool:
        """Whether gains are being made."""
        return self._channel is not None and self._channel.busy

    def close(self) -> None:
        """Give back what it holds elsewhere."""
        if self._channel is not None:
            self._channel.close()

    def due(
        self, proposal: StateModel | None, structure: ControlStructure, serial: SerialPlant | None,
    ) -> Design | None:
        """The design that takes over now; None for none.

        proposal: the newest G that the estimator proposes.
        """
        self._poll()
        if proposal is not None and proposal is not self.considered and not self.busy:
            self.considered, self._made, self._waited = proposal, False, 0
            commanded = proposal if serial is None else serial.before(proposal)
            self._design = Design(proposal, commanded)
            job = structure.redesign(commanded)
            if job is None:
                self._made = True
            else:
                self._channel = self._channel or self.executor.open()
                self._channel.submit(_designed, job)
                self._poll()
        if not self._made:
            return None
        self._waited += 1
        if not structure.may_change and self._waited <= LONGEST_WAIT:
            return None
        self._made = False
        return self._design

    def _poll(self) -> None:
        """Take up gains that are finished."""
        found = self._channel.poll() if self._channel is not None and self._channel.busy else None
        if isinstance(found, Failure):
            if found.kind == LOST:
                self.considered = None  # the same again, by another worker
            else:
                self.failed += 1
        elif found is not None and found[0] is not None and self._design is not None:
            self._design, self._made = self._design._replace(gains=found[0]), True


def _designed(make: Callable[[], object | None]) -> tuple[object | None]:
    """Gains, or None where the present ones are safer, as a result that is never None."""
    return make(),
