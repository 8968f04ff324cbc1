"""From checked parameters to what a controller meets: G(z), the simulated plant, y_m.

Apart from assembly.py, so that the nodes for these start without loading what learns and controls.
"""

from __future__ import annotations

import numpy as np

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.simulated_plant import Imperfections, SimulatedPlant
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.plant.true_plant import Alteration, altered_plant, delayed
from backlash_ros.core.reference.file import read_reference_file
from backlash_ros.core.reference.signal import ReferenceSignal


def build_model(p: Parameters) -> TransferFunction:
    """G(z), and the delay between control and its effect as poles at 0."""
    delay = (0.0,) * p.control.delay_samples
    return TransferFunction(
        p.plant.numerator, p.plant.denominator + delay
    )


def build_actuator(p: Parameters) -> Actuator | None:
    """What lies between control and applied_control; None where nothing does."""
    numerator = p.actuator.numerator
    denominator = p.actuator.denominator
    if not (numerator or denominator):
        return None
    return Actuator(
        TransferFunction(numerator, denominator, 'actuator'), p.actuator.wind_up
    )


def build_true_model(p: Parameters) -> TransferFunction:
    """G(z) of the simulated plant, which truth.* may set apart from the one that is known.

    Raises ParameterError where that G(z) cannot be altered as truth.* asks.
    """
    delay = p.truth.delay_samples
    if delay < 0:
        delay = p.control.delay_samples
    numerator, denominator = p.truth.numerator, p.truth.denominator
    base = TransferFunction(
        numerator or p.plant.numerator,
        denominator or p.plant.denominator,
        'truth' if numerator or denominator else 'plant',
    )
    altered = altered_plant(base, Alteration(
        p.truth.scale_frequency, p.truth.scale_damping,
        p.truth.extra_lag / p.sample_period,
    ))
    return delayed(altered, delay)


def build_plant(p: Parameters) -> SimulatedPlant:
    """The simulated plant with its hidden backlash."""
    backlash = Backlash(
        p.backlash.m, p.backlash.c_r, p.backlash.c_l,
        p.backlash.initial_u,
    )
    imperfections = Imperfections(
        p.output_noise_std,
        p.output_quantum,
        p.input_disturbance,
        p.truth.walk_std,
        p.backlash.rate,
        p.backlash.jump_time,
        p.backlash.jump,
    )
    rng = np.random.default_rng(p.seed)
    return SimulatedPlant(
        build_true_model(p), backlash, p.sample_period, rng, imperfections,
        build_actuator(p),
    )


def build_reference(p: Parameters) -> ReferenceSignal:
    """y_m(t); reads the file for waveform: file."""
    return ReferenceSignal(
        p.waveform,
        p.amplitude,
        p.frequency,
        p.bias,
        p.frequency_start,
        p.sweep_time,
        p.sample_period,
        read_reference_file(p),
    )
