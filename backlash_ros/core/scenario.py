"""From checked parameters to what a controller meets: G(z), the simulated plant, y_m.

Apart from assembly.py, so that the nodes for these start without loading what learns and controls.
"""

from __future__ import annotations

import numpy as np

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.simulated_plant import Imperfections, SimulatedPlant
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.plant.true_plant import Alteration, altered_plant, delayed
from backlash_ros.core.reference.file import read_reference_file
from backlash_ros.core.reference.signal import ReferenceSignal


def build_model(p: Parameters) -> TransferFunction:
    """G(z), and the delay between control and its effect as poles at 0."""
    delay = (0.0,) * p.integer('control.delay_samples')
    return TransferFunction(p.reals('plant.numerator'), p.reals('plant.denominator') + delay)


def build_true_model(p: Parameters) -> TransferFunction:
    """G(z) of the simulated plant, which truth.* may set apart from the one that is known.

    Raises ParameterError where that G(z) cannot be altered as truth.* asks.
    """
    delay = p.integer('truth.delay_samples')
    if delay < 0:
        delay = p.integer('control.delay_samples')
    numerator, denominator = p.reals('truth.numerator'), p.reals('truth.denominator')
    base = TransferFunction(
        numerator or p.reals('plant.numerator'), denominator or p.reals('plant.denominator'),
        'truth' if numerator or denominator else 'plant',
    )
    altered = altered_plant(base, Alteration(
        p.real('truth.scale_frequency'), p.real('truth.scale_damping'),
        p.real('truth.extra_lag') / p.real('sample_period'),
    ))
    return delayed(altered, delay)


def build_plant(p: Parameters) -> SimulatedPlant:
    """The simulated plant with its hidden backlash."""
    backlash = Backlash(
        p.real('backlash.m'), p.real('backlash.c_r'), p.real('backlash.c_l'),
        p.real('backlash.initial_u'),
    )
    imperfections = Imperfections(
        p.real('output_noise_std'), p.real('output_quantum'), p.real('input_disturbance'),
        p.real('truth.walk_std'), p.triple('backlash.rate'), p.real('backlash.jump_time'),
        p.triple('backlash.jump'),
    )
    rng = np.random.default_rng(p.integer('seed'))
    return SimulatedPlant(
        build_true_model(p), backlash, p.real('sample_period'), rng, imperfections
    )


def build_reference(p: Parameters) -> ReferenceSignal:
    """y_m(t); reads the file for waveform: file."""
    return ReferenceSignal(
        p.word('waveform'), p.real('amplitude'), p.real('frequency'), p.real('bias'),
        p.real('frequency_start'), p.real('sweep_time'), p.real('sample_period'),
        read_reference_file(p),
    )
