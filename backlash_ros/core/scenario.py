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
    delay = (0.0,) * p.get_int('control.delay_samples')
    return TransferFunction(
        p.get_floats('plant.numerator'), p.get_floats('plant.denominator') + delay
    )


def build_actuator(p: Parameters) -> Actuator | None:
    """What lies between control and applied_control; None where nothing does."""
    numerator = p.get_floats('actuator.numerator')
    denominator = p.get_floats('actuator.denominator')
    if not (numerator or denominator):
        return None
    return Actuator(
        TransferFunction(numerator, denominator, 'actuator'), p.get_pair('actuator.wind_up')
    )


def build_true_model(p: Parameters) -> TransferFunction:
    """G(z) of the simulated plant, which truth.* may set apart from the one that is known.

    Raises ParameterError where that G(z) cannot be altered as truth.* asks.
    """
    delay = p.get_int('truth.delay_samples')
    if delay < 0:
        delay = p.get_int('control.delay_samples')
    numerator, denominator = p.get_floats('truth.numerator'), p.get_floats('truth.denominator')
    base = TransferFunction(
        numerator or p.get_floats('plant.numerator'),
        denominator or p.get_floats('plant.denominator'),
        'truth' if numerator or denominator else 'plant',
    )
    altered = altered_plant(base, Alteration(
        p.get_float('truth.scale_frequency'), p.get_float('truth.scale_damping'),
        p.get_float('truth.extra_lag') / p.get_float('sample_period'),
    ))
    return delayed(altered, delay)


def build_plant(p: Parameters) -> SimulatedPlant:
    """The simulated plant with its hidden backlash."""
    backlash = Backlash(
        p.get_float('backlash.m'), p.get_float('backlash.c_r'), p.get_float('backlash.c_l'),
        p.get_float('backlash.initial_u'),
    )
    imperfections = Imperfections(
        p.get_float('output_noise_std'),
        p.get_float('output_quantum'),
        p.get_float('input_disturbance'),
        p.get_float('truth.walk_std'),
        p.get_triple('backlash.rate'),
        p.get_float('backlash.jump_time'),
        p.get_triple('backlash.jump'),
    )
    rng = np.random.default_rng(p.get_int('seed'))
    return SimulatedPlant(
        build_true_model(p), backlash, p.get_float('sample_period'), rng, imperfections,
        build_actuator(p),
    )


def build_reference(p: Parameters) -> ReferenceSignal:
    """y_m(t); reads the file for waveform: file."""
    return ReferenceSignal(
        p.get_str('waveform'),
        p.get_float('amplitude'),
        p.get_float('frequency'),
        p.get_float('bias'),
        p.get_float('frequency_start'),
        p.get_float('sweep_time'),
        p.get_float('sample_period'),
        read_reference_file(p),
    )
