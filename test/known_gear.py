"""A gear that was known before the run: the estimator that begins with it, and y behind its G."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.parameters import Parameters

# Second order, 20 Hz, at 200 Hz, as in geared_motor.yaml.
NUMERATOR, DENOMINATOR = (0.15678154, 0.12688103), (1.0, -1.24982552, 0.53348809)
PARAMETERS = Parameters({
    'sample_period': 0.005, 'plant.numerator': NUMERATOR, 'plant.denominator': DENOMINATOR,
    'plant.uncertainty': 0.05, 'estimator.output_noise_std': 1e-4,
    'estimator.initial.m': 1.0, 'estimator.initial.c_r': 0.5, 'estimator.initial.c_l': -0.5,
})
KNOWN = Estimate(1.0, 0.5, -0.5, 0.0, 1e-3, 2e-3, 2e-3)


def estimator_knowing(known: Estimate) -> Law:
    return build_controller(PARAMETERS, known).estimator


def answers(u: list[float], late: int = 0) -> NDArray[np.float64]:
    return np.asarray(lfilter([0.0] * late + list(NUMERATOR), DENOMINATOR, u))


def learn(estimator: Law, v: float, y: float) -> None:
    estimator.update(y, Interval(v, v, v, 0.0))
    estimator.refine()
