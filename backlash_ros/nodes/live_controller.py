"""Parameters of the controller that may change while it runs."""

from __future__ import annotations

from backlash_ros.core.assembly import build_controller, build_limits
from backlash_ros.core.controller import AdaptiveController
from backlash_ros.core.errors import ParameterError
from backlash_ros.core.lms import NormalisedLms
from backlash_ros.core.parameters import Parameters


# Marked as live in the table, but what was learned rests on them.
FIXED = ('estimator.output_noise_std',)


def check_live(old: Parameters, new: Parameters) -> None:
    """Raise ParameterError for changes that a running controller cannot take up."""
    build_controller(new)
    for name in FIXED:
        if new[name] != old[name]:
            raise ParameterError(
                name, new[name], 'cannot change while the controller runs', 'start it anew'
            )


def apply_live(controller: AdaptiveController, parameters: Parameters) -> None:
    """Take up limits, inverse and step sizes without touching what was learned."""
    controller.limits = build_limits(parameters)
    inverse = controller.inverse
    inverse.direction_band = parameters.real('inverse.direction_band')
    inverse.take_up = parameters.real('inverse.take_up_rate') * parameters.real('sample_period')
    if isinstance(controller.estimator, NormalisedLms):
        controller.estimator.step = parameters.real('lms.step')
        controller.estimator.step_f = parameters.real('lms.step_f')
