"""A motor, a worn 10:1 gear and a load, in place of hardware; config/geared_motor.yaml knows it."""

import math
import time

SLOPE, C_R, C_L = 0.098, 0.55, -0.35  # of the gear: gear output per motor angle, play [rad]
B1, B2 = 0.15678154198771987, 0.12688103331610767  # load behind the gear output, G(z) at 5 ms
A1, A2 = -1.2498255157872757, 0.5334880910911033
ENCODER_STEP = 2.0 * math.pi / 2**14
EARLY = 0.1  # of a period; timers are punctual to that
LATE_START = 0.7  # of a period; by so much the first reading may have been late


class SimulatedMotor:
    """Moves on by itself: each reading of the encoder brings it to the present."""

    def __init__(self, sample_period_s: float) -> None:
        self._period = sample_period_s
        self._begin = 0.0  # of sample 0, on the steady clock [s]
        self._sample = -1
        self._v = self._u = self._x1 = self._x2 = 0.0

    def move_to(self, v: float) -> None:
        """Set the position of the motor [rad]."""
        self._v = v

    def motor_encoder(self) -> float:
        """Position of the motor [rad]."""
        return self._v

    def load_encoder(self) -> float:
        """Angle of the load now [rad]."""
        now = time.monotonic()
        if self._sample < 0:
            self._begin, self._sample = now, 0
        early = self._begin + (self._sample + 1) * self._period - now
        if 0.0 < early < LATE_START * self._period:
            # Timers are never early: the readings before were late.
            self._begin -= early
        while self._sample < int((now - self._begin) / self._period + EARLY):
            self._step()
        return ENCODER_STEP * round(self._x1 / ENCODER_STEP)

    def _step(self) -> None:
        self._sample += 1
        self._u = min(max(self._u, SLOPE * (self._v - C_R)), SLOPE * (self._v - C_L))
        y = self._x1
        self._x1 = -A1 * y + self._x2 + B1 * self._u
        self._x2 = -A2 * y + B2 * self._u
