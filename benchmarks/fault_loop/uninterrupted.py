"""The command that `proportional` would have given had there been no interruption."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

from backlash_ros.core.control.controller import AdaptiveController, ControlStep
from backlash_ros.core.control.limits import at_rest
from backlash_ros.core.control.protocol import ControlInput


class Uninterrupted:
    """Inverse and structure of a core as they are now, to go on with what will be asked of it.

    y and what is known of G do not matter to (3.2). So v, which was held, has to go on from an
    interruption to the last bit as if there had been none.
    """

    def __init__(self, core: AdaptiveController) -> None:
        self._inverse, self._structure = copy(core.inverse), copy(core.structure)

    def command(self, step: ControlStep, core: AdaptiveController, band: float) -> float:
        """v instead of that of the step. core: for what may be set meanwhile, as band, too."""
        inverse, v_before = self._inverse, self._inverse.v
        inverse.take_up = core.inverse.take_up
        inverse.direction_band = band
        used = step.estimate if core.compensating else replace(step.estimate, c_r=0.0, c_l=0.0)
        inputs = ControlInput(step.y_m, step.y, used, core.estimator)
        return core.limits.apply(self._structure.control(inputs, inverse).v, at_rest(v_before)).v
