"""A motor with its position loop, and the plant behind it, as one plant of the command.

Where v is the position of a motor encoder, G begins behind the position loop. The estimator learns
from that v; the structure however commands the motor, and y answers as L(z) G(z) does. Backlash
and L change places in it, as each crossing of the gap takes far longer than L: the structure
inverts the gap with the wind-up of the motor added.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import GATE, OUTLIERS
from backlash_ros.core.estimation.observer.observer import INNOVATIONS, Observer
from backlash_ros.core.estimation.protocol import Estimate
from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import Region, clamp
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

REMEMBERED = 200  # samples from which the state of another G is found


class SerialPlant:
    """Follows motor and plant from sample to sample: the source of x_hat for a structure.

    model: G behind the motor. noise_std: of y.
    """

    def __init__(self, actuator: Actuator, model: StateModel, noise_std: float) -> None:
        self._actuator, self._noise_std = actuator, noise_std
        self._motor, self._side = Motor(actuator), Region.GAP
        self._play = self._commanded = nan  # what the gap holds, in units of v and of the command
        self._newest: deque[tuple[float, float | None]] = deque(maxlen=REMEMBERED)  # u and y
        self.adopt(self.before(model))

    def before(self, model: StateModel) -> StateModel:
        """L G for a G."""
        return StateModel(self._actuator.in_front_of(model.transfer_function))

    def adopt(self, model: StateModel) -> None:
        """Give x_hat for this L G from now on."""
        self.model = model
        self._observer = Observer(model, self._noise_std)
        self._samples = self._refused = 0
        for u, y in self._newest:
            self._follow(y, u)

    @property
    def x_hat(self) -> list[float]:
        """State of L G in the coordinates of `model`, n values."""
        return self._observer.state

    @property
    def x_cov(self) -> Array:
        """Covariance of x_hat, shape (n, n)."""
        return self._observer.cov

    def for_command(self, estimate: Estimate) -> Estimate:
        """The estimate with its crossings as the command meets them."""
        c_r, c_l = self._actuator.crossings(estimate.c_r, estimate.c_l)
        return replace(estimate, c_r=c_r, c_l=c_l)

    def command_of(self, v: float) -> float:
        """The command at which the motor rests at v."""
        return v / self._actuator.gain

    def position(self, command: float) -> float:
        """Where the motor is at the end of an interval by the command of it; once per interval."""
        return self._motor.step(command, self._side)

    def update(self, y: float | None, command: float, v: float, estimate: Estimate) -> None:
        """Take in y(k), None if it was lost, and command and v of the interval before it."""
        self._play = play = _played(self._play, v, estimate)
        gap = estimate.c_r - estimate.c_l
        self._side = (
            Region.RIGHT if play == v else Region.LEFT if play == v + gap else Region.GAP
        )
        # Nothing is known of the gap before it was learned.
        gapless = replace(estimate, c_r=0.0, c_l=0.0)
        seen = self.for_command(estimate if estimate.learned else gapless)
        self._commanded = _played(self._commanded, command, seen)
        u = seen.m * (self._commanded - seen.c_r)
        self._newest.append((u, y))
        self._follow(y, u)

    def _follow(self, y: float | None, u: float) -> None:
        observer = self._observer
        if not self._samples:
            if y is not None:
                observer.start(self.model.equilibrium * y, None)
                self._samples = 1
            return
        expected = observer.predict(u)
        self._samples += 1
        if y is None:
            return
        innovation = y - expected
        if innovation**2 > GATE**2 * observer.variance and self._refused < OUTLIERS:
            self._refused += 1
            return
        self._refused = 0
        observer.correct(innovation)
        if self._samples % INNOVATIONS == 0:
            observer.settle(self._noise_std)


def _played(held: float, v: float, estimate: Estimate) -> float:
    """What the gap holds at v; in its middle where nothing is known of before."""
    gap = estimate.c_r - estimate.c_l
    return clamp(v + 0.5 * gap if held != held else held, v, v + gap)
