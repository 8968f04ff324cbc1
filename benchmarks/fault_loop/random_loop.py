"""Random loops: plants, backlashes, laws, structures, limits and references."""

from __future__ import annotations

import numpy as np
from cases.random_cases import random_plant

from backlash_ros.core.assembly import build_controller, build_model, build_plant, law_fits
from backlash_ros.core.parameters import Parameters

PERIOD_S = 0.01
LAWS = ('moving_horizon',) * 4 + ('lms', 'printed', 'fixed', 'gradient')
STRUCTURES = ('proportional', 'tracking', 'pole_placement')


def parameters_of(rng: np.random.Generator) -> tuple[Parameters, float]:
    """Parameters of a loop, and the swing of its y."""
    law = str(rng.choice(LAWS))
    structure = str(rng.choice([name for name in STRUCTURES if law_fits(law, name)]))
    numerator, denominator, _ = random_plant(rng)
    m = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    c_r, c_l = (float(np.exp(rng.uniform(np.log(0.2), np.log(8.0)))) for _ in range(2))
    gap = c_r + c_l
    omega = 2.0 * np.pi / (int(rng.integers(40, 150)) * PERIOD_S)
    factors = 10.0 ** rng.uniform(-0.7, 0.7, 3)
    u_swing = float(rng.uniform(0.4, 4.0)) * m * gap
    f = 0.22 * m if rng.random() < 0.5 else 0.0
    values: dict[str, object] = {
        'sample_period': PERIOD_S, 'estimator.law': law, 'structure': structure,
        'plant.numerator': numerator.tolist(), 'plant.denominator': denominator.tolist(),
        'control.delay_samples': int(rng.choice([0, 0, 1])),
        'backlash.m': m, 'backlash.c_r': c_r, 'backlash.c_l': -c_l,
        'estimator.initial.m': m * factors[0], 'estimator.initial.c_r': c_r * factors[1],
        'estimator.initial.c_l': -c_l * factors[2], 'proportional.f': f,
        'waveform': str(rng.choice(['sine', 'multisine', 'square', 'triangle'])),
        'frequency': float(omega), 'seed': int(rng.integers(2**31)),
        'timeout.plant_output': float(rng.uniform(0.1, 0.5)),
    }
    gain = abs(complex(build_model(Parameters(values)).response(
        np.exp(1j * np.array([omega * PERIOD_S])))[0]))
    y_swing = u_swing * gain
    v_swing = u_swing / m + gap
    values['amplitude'] = u_swing if structure == 'proportional' else y_swing
    noise = y_swing * 10.0 ** float(rng.uniform(-5.0, -2.0))
    values['output_noise_std'] = noise
    values['estimator.output_noise_std'] = noise * float(rng.choice([0.3, 1.0, 3.0]))
    if rng.random() < 0.3:
        values['truth.scale_frequency'] = float(rng.uniform(0.85, 1.15))
    if rng.random() < 0.75:
        values['control.min'] = -v_swing * float(rng.uniform(0.7, 3.0))
        values['control.max'] = v_swing * float(rng.uniform(0.7, 3.0))
    actions = ['hold', 'zero']
    if rng.random() < 0.6:
        values['control.rate_max'] = v_swing * float(omega * rng.uniform(1.0, 10.0))
        actions.append('ramp')
    if rng.random() < 0.2:
        values['inverse.take_up_rate'] = v_swing * float(omega * rng.uniform(0.5, 5.0))
    if rng.random() < 0.2:
        values['inverse.direction_band'] = 0.02 * u_swing
    values['on_stop'], values['on_timeout'] = (str(rng.choice(actions)) for _ in range(2))
    p = Parameters(values)
    build_controller(p)
    build_plant(p)
    return p, y_swing
