"""A load behind a gap that coasts: a dead zone with stiffness, inertia and friction.

Unlike the play of (2.1) the load is not held within the gap: it goes on until it meets the other
side, friction stops it or it bounces. With z the way into the contact,

    J x'' = k z - b x' - friction,   z = p - x - m c_r if > 0,  p - x - m c_l if < 0,  else 0

p = m v, and v moves evenly within a sample. In contact, without dry friction, x follows p like
1 / (1 + 2 d s/w + s^2/w^2) with w^2 = k/J and 2 d w = b/J.
"""

from math import copysign, pi

from backlash_ros.core.plant.backlash import Backlash

STEP_S = 0.25e-3  # of the integration


class CoastingLoad:
    """The load, with the interface of SimulatedPlant.

    frequency: of the contact [Hz]. damping: ratio d of the viscous friction. dry: deceleration by
    dry friction [unit of y / s^2]. quantum: of the sensor, 0 for none [unit of y].
    """

    def __init__(
        self, backlash: Backlash, period_s: float, frequency: float = 20.0, damping: float = 0.5,
        dry: float = 0.0, quantum: float = 0.0,
    ) -> None:
        self.backlash = backlash  # what a play between the same parts would let through
        self.sample = 0
        self._stiffness = (2.0 * pi * frequency) ** 2
        self._viscous = 4.0 * pi * damping * frequency
        self._dry, self._quantum = dry, quantum
        self._steps = round(period_s / STEP_S)
        self._v = self._x = self._speed = 0.0

    def measure(self) -> float:
        return self._quantum * round(self._x / self._quantum) if self._quantum else self._x

    def step(self, v: float) -> float:
        """Move the input to v over one sample period; return the output of a play."""
        for i in range(1, self._steps + 1):
            self._advance(self._v + (v - self._v) * i / self._steps)
        self._v = v
        self.sample += 1
        return self.backlash.step(v)

    def _advance(self, v: float) -> None:
        play = self.backlash
        right, left = play.m * (v - play.c_r) - self._x, play.m * (v - play.c_l) - self._x
        depth = right if right > 0.0 else min(left, 0.0)
        push = self._stiffness * depth - self._viscous * self._speed
        if self._speed == 0.0 and abs(push) <= self._dry:
            return
        moved = self._speed + STEP_S * (push - copysign(self._dry, self._speed or push))
        # Dry friction stops the load and does not turn it round.
        self._speed = 0.0 if moved * self._speed < 0.0 and abs(push) <= self._dry else moved
        self._x += STEP_S * self._speed
