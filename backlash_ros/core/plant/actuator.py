"""Model of a motor with a position loop in front of the backlash.

    q(k+1) = L(z) (command(k) - offset),   v = q - L(1) w while it pushes the load to the right

v is the position of the motor, which its encoder reports at the end of an interval. Dry friction of
the load winds the loop up by w before the load moves; until then v stays where it met the load.
"""

from dataclasses import dataclass

import numpy as np

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.transfer_function import TransferFunction


@dataclass(frozen=True)
class Actuator:
    """lag: L(z). wind_up: (right, left), how much further the command has to go [unit of v].

    Raises ParameterError if L is not stable or L(1) is not positive.
    """

    lag: TransferFunction
    wind_up: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        poles = self.lag.poles
        if np.abs(poles).max() >= 1.0:
            raise ParameterError(
                'actuator.denominator', self.lag.denominator.tolist(),
                f'has the pole {poles[np.abs(poles).argmax()]:.6g}, must have all within the unit '
                'circle', 'the motor comes to rest where the command says',
            )
        if not self.gain > 0.0:
            raise ParameterError('actuator.numerator', self.lag.numerator.tolist(),
                                 f'has the gain {self.gain:.3g} at rest, must be > 0')

    @property
    def gain(self) -> float:
        """Gain at rest, L(1)."""
        return float(self.lag.numerator.sum() / self.lag.denominator.sum())

    def crossings(self, c_r: float, c_l: float) -> tuple[float, float]:
        """Convert the crossings of v, behind the motor, to those of the command."""
        right, left = self.wind_up
        return c_r / self.gain + right, c_l / self.gain - left

    def in_front_of(self, model: TransferFunction) -> TransferFunction:
        """Return L(z) G(z), from the command to y.

        G expects the v of an interval at its beginning, and L gives it at the end: hence z L G.
        """
        numerator = np.convolve(np.trim_zeros(self.lag.numerator, 'f'), model.numerator)
        denominator = np.convolve(self.lag.denominator, model.denominator)
        if denominator[-1] == 0.0:
            denominator = denominator[:-1]
        else:
            numerator = np.append(numerator, 0.0)
        return TransferFunction(numerator.tolist(), denominator.tolist())


class Motor:
    """Predicts the motor position from the command; begins at rest at the first command."""

    def __init__(self, actuator: Actuator) -> None:
        right, left = actuator.wind_up
        self._offset = 0.5 * (right - left)
        self._wind_up = 0.5 * (right + left) * actuator.gain  # [v]
        self._lag, self._x = actuator.lag, list[float]()

    def step(self, command: float, load: float, c_r: float, c_l: float) -> float:
        """Advance by one sample; return v at its end. load: u / m, position of the load [v]."""
        reached = command - self._offset
        if not self._x:
            a, b, _ = self._lag.state_space()
            self._x = (np.linalg.solve(np.eye(len(b)) - a, b) * reached).tolist()
        q, w = self._lag.advance(self._x, reached), self._wind_up
        load = clamp(load, q - w - c_r, q + w - c_l)
        return clamp(q, load + c_l, load + c_r)
