"""A motor with its position loop, and the plant behind it, as one plant of the command.

Where v is the position of a motor encoder, G begins behind the position loop. The estimator learns
from that v; the structure however commands the motor, and y answers as L(z) G(z) does. The gap and
L change places in it, as L takes less time than a motion does: the structure inverts the gap with
the wind-up of the motor added.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import isnan, nan

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.settings import OUTLIERS
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.transfer_function import StateModel

# Share of the motion of u that may not be what the backlash says, before and after it was learned.
DOUBT, LITTLE_DOUBT = 0.5, 0.1


class SerialPlant:
    """Follows motor and plant from sample to sample; model: G behind it. noise_std: of y.

    observer: the source of x_hat of L G for a structure.
    """

    def __init__(self, actuator: Actuator, model: StateModel, noise_std: float) -> None:
        self.actuator, self._noise_std, self._motor = actuator, noise_std, Motor(actuator)
        # What the gap holds, in units of v and of the command: its middle where it begins.
        self._play = self._commanded = nan
        self._learned = False
        # u and y, from which a new observer finds the state.
        self._newest: deque[tuple[float, float | None]] = deque(maxlen=60)
        self.adopt(self.before(model))

    def before(self, model: StateModel) -> StateModel:
        """L G for a G."""
        return StateModel(self.actuator.in_front_of(model.transfer_function))

    def adopt(self, model: StateModel) -> None:
        """Give x_hat for this L G from now on."""
        self._model = model
        # It is told u: to the observer there is no backlash.
        self.observer = FixedBacklash(Estimate(1.0, 0.0, 0.0, 0.0), model, self._noise_std,
                                       LITTLE_DOUBT if self._learned else DOUBT)
        self._variance, self._taken, self._refused = 0.0, 0, 0
        for u, y in self._newest:
            self._follow(y, u)

    def for_command(self, estimate: Estimate) -> Estimate:
        """The estimate with its crossings as the command meets them."""
        c_r, c_l = self.actuator.crossings(estimate.c_r, estimate.c_l)
        return replace(estimate, c_r=c_r, c_l=c_l)

    def update(
        self, y: float | None, command: float, applied: float | None, estimate: Estimate,
    ) -> float:
        """Take in y(k), None if it was lost, and the command of the interval before it.

        Returns its v: as it was reported, else where the command takes the motor.
        """
        c_r, c_l, gap = estimate.c_r, estimate.c_l, estimate.c_r - estimate.c_l
        play = command * self.actuator.gain + c_r if isnan(self._play) else self._play
        position = self._motor.step(command, play - c_r, c_r, c_l)
        v = position if applied is None else applied
        self._play = clamp(v + 0.5 * gap if isnan(self._play) else self._play, v, v + gap)
        # Nothing is known of the gap before it was learned.
        seen = self.for_command(
            estimate if estimate.learned else replace(estimate, c_r=0.0, c_l=0.0))
        gap = seen.c_r - seen.c_l
        held = command + 0.5 * gap if isnan(self._commanded) else self._commanded
        self._commanded = clamp(held, command, command + gap)
        if estimate.learned is not self._learned:
            self._learned = estimate.learned
            self.adopt(self._model)
        u = seen.m * (self._commanded - seen.c_r)
        self._newest.append((u, y))
        self._follow(y, u)
        return v

    def _follow(self, y: float | None, u: float) -> None:
        averaged = 100  # innovations, of whose rms y may differ: they come in bursts at crossings
        observer = self.observer
        if y is not None and self._taken >= averaged:
            least = max(self._variance, self._noise_std**2)
            # So many outliers in a row are none.
            if (y - observer.predicted(u)) ** 2 > 100.0**2 * least and self._refused < OUTLIERS:
                self._refused += 1
                y = None
        observer.update(y, Interval(u, nan, nan, nan))
        if y is not None:
            self._refused = 0
            self._taken += 1
            change = observer.innovation**2 - self._variance
            self._variance += change / min(self._taken, averaged)
