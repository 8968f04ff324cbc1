"""identified.yaml and identified.json: what was found, as parameters and as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from backlash_ros.core.assembly import build_controller, first_guess
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.identification.identification import Identification
from backlash_ros.core.identification.least_response import known_up_to
from backlash_ros.core.identification.uncertainty import response
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import Parameter, Value
from backlash_ros.core.parameters.table import BRINGUP, BY_NAME, PARAMETERS, PLANT, RECORDER
from backlash_ros.tools.config import ANY, EVERY_NODE, yaml_value

LEAST_DEVIATION = 1e-6  # relative: a deviation of 0 would say that a constant was given
WIDER = 3.0  # bounds of the estimates, in times of what was found
SIMULATED = ('truth', 'backlash', 'output_noise_std', 'output_quantum', 'input_disturbance')
OF_ONE_RUN = ('estimates', 'bag', 'lockstep', 'wait_for_subscribers', 'wait_for_publishers', 'axes')
WIDER_THAN_GAP, MOST_OF_REACH = 0.75, 0.8  # amplitude in gaps that shows the gap, within reach
SHARE_OF_REACH = 0.4  # of the range of v less the gap, which the reference asks for
LITTLE = 0.1  # of the gain at the lowest frequency: faster motion of y takes too much of v
USUAL_FREQUENCY = np.pi / 10.0  # [rad/sample] at which tracking.input_weight takes |G|
PREVIEW, LONGEST_PREVIEW = 6.0, 600  # radians of that motion; samples


def identified_parameters(
    found: Identification, given: Mapping[str, Value], estimates: Path | None = None,
) -> Parameters:
    """The complete set: what was found, in what the user has given, and defaults for the rest.

    estimates: file of what the controller is to begin with.

    Raises ParameterError where the controller does not take it.
    """
    values: dict[str, Any] = {
        name: value for name, value in given.items()
        if not name.startswith(SIMULATED) and not name.startswith(OF_ONE_RUN)
    }
    reach = max(abs(found.c_r), abs(found.c_l)) + found.std['c_r']
    scale = float(f'{max(WIDER * max(found.gap, reach), 1e-9):.3g}')
    values.update({
        'sample_period': found.sample_period,
        'plant.numerator': found.numerator,
        'plant.denominator': found.denominator,
        'plant.uncertainty': found.uncertainty,
        'control.delay_samples': found.delay,
        'estimator.initial.m': found.m,
        'estimator.initial.c_r': float(f'{found.c_r:.6g}'),
        'estimator.initial.c_l': float(f'{found.c_l:.6g}'),
        'estimator.bounds.m': (float(f'{found.m / WIDER:.3g}'), float(f'{found.m * WIDER:.3g}')),
        'estimator.bounds.c_r': (-scale, scale), 'estimator.bounds.c_l': (-scale, scale),
        'estimator.output_noise_std': float(f'{max(found.noise_std, 1e-12):.3g}'),
        # The simulated plant is the one that was found, so that the file can be tried out.
        'backlash.m': found.m,
        'backlash.c_r': float(f'{found.c_r:.6g}'), 'backlash.c_l': float(f'{found.c_l:.6g}'),
        'output_quantum': float(f'{found.quantum:.6g}'),
        'output_noise_std': 0.0 if found.quantum else float(f'{found.noise_std:.3g}'),
    })
    values.update(_actuator(found))
    for name, value in {
        **_reference(found, given), **_limits(found), **_weights(found), **_reports(found),
    }.items():
        values.setdefault(name, value)
    if estimates is not None:
        values.update({'estimates.file': str(estimates), 'estimates.load': True})
    parameters = Parameters(values) if 'structure' in given else _with_structure(values)
    # estimates.file is yet to be written, perhaps over that of another record.
    build_controller(parameters, first_guess(parameters))
    return parameters


def as_estimate(found: Identification, parameters: Parameters) -> Estimate:
    """What a controller may begin with, as if it had learned it itself."""
    least = LEAST_DEVIATION * max(found.gap, abs(found.c_r), abs(found.c_l))
    return Estimate(
        found.m, parameters.estimator.initial.c_r,
        parameters.estimator.initial.c_l, parameters.proportional.f,
        max(found.std['m'], LEAST_DEVIATION * found.m), max(found.std['c_r'], least),
        max(found.std['c_l'], least),
    )


def _with_structure(values: dict[str, Any]) -> Parameters:
    """y follows y_m where gains for that can be designed, else u_d = y_m."""
    try:
        parameters = Parameters({**values, 'structure': 'tracking'})
        build_controller(parameters, first_guess(parameters))
    except (ParameterError, ValueError, ArithmeticError, np.linalg.LinAlgError):
        return Parameters({**values, 'structure': 'proportional', 'proportional.f': 0.0})
    return parameters


def _actuator(found: Identification) -> dict[str, Value]:
    """L(z) and the wind-up, none where v is the command: whatever the file had is outdated."""
    if found.actuator is None:
        return {'actuator.numerator': (), 'actuator.denominator': (),
                'actuator.wind_up': (0.0, 0.0)}
    lag, (right, left) = found.actuator.lag, found.actuator.wind_up
    return {
        'actuator.numerator': tuple(lag.numerator.tolist()),
        'actuator.denominator': tuple(lag.denominator.tolist()),
        'actuator.wind_up': (float(f'{right:.6g}'), float(f'{left:.6g}')),
    }


def _reports(found: Identification) -> dict[str, Value]:
    """G begins behind what is reported."""
    return {} if found.actuator is None else {'estimator.use_applied_control': 'true'}


def _reference(found: Identification, given: Mapping[str, Value]) -> dict[str, Value]:
    """A reference that the actuator can follow, unless one is given."""
    if {'waveform', 'amplitude', 'frequency', 'bias', 'file'} & set(given):
        return {}
    y = found.y[np.isfinite(found.y)]
    middle = 0.0 if found.integrator else 0.5 * float(np.percentile(y, 5) + np.percentile(y, 95))
    assert found.details is not None
    gain = float(np.abs(response(found.details.fit, found.frequencies[:1]))[0])
    reach = 0.5 * (float(np.ptp(found.v)) - found.gap)
    share = max(SHARE_OF_REACH, min(WIDER_THAN_GAP * found.gap / reach, MOST_OF_REACH))
    return {
        'waveform': 'sine', 'amplitude': float(f'{share * gain * reach:.3g}'),
        'bias': float(f'{middle:.3g}'),
        'frequency': float(f'{found.frequencies[0] / found.sample_period:.3g}'),
    }


def _weights(found: Identification) -> dict[str, Value]:
    """The usual weight of u, at a frequency where G is known and v still moves y."""
    assert found.details is not None
    fit = found.details.fit
    w = np.linspace(found.frequencies[0], USUAL_FREQUENCY, 200)
    gain = np.abs(response(fit, w))
    if found.actuator is not None:
        gain = gain * np.abs(found.actuator.lag.response(np.exp(1j * w)))
    limit = known_up_to(fit, found.details.covariance)
    beyond = np.flatnonzero((w > limit) | (gain < LITTLE * gain[0]))
    if not len(beyond):
        return {}
    last = max(int(beyond[0]) - 1, 0)
    default, usual = (
        BY_NAME[f'tracking.{name}'].default for name in ('input_weight', 'preview')
    )
    assert isinstance(default, float)
    assert isinstance(usual, int)
    weight, w = default * max(float(gain[last] / gain[-1]), 1.0)**2, w[last]
    preview = min(max(round(PREVIEW / w), usual), LONGEST_PREVIEW)
    return {'tracking.input_weight': float(f'{weight:.2g}'), 'tracking.preview': preview}


def _limits(found: Identification) -> dict[str, Value]:
    """Where none are given: v as far and as fast as it went in the record, and no further."""
    fastest = float(np.abs(np.diff(found.v)).max()) / found.sample_period
    # Digits that the swing bears, wherever 0 of v is.
    digits = 3 - int(np.floor(np.log10(np.ptp(found.v))))
    return {
        'control.min': round(float(found.v.min()), digits),
        'control.max': round(float(found.v.max()), digits),
        'control.rate_max': float(f'{fastest:.4g}'),
    }


def numbers(found: Identification) -> dict[str, Any]:
    """Content of identified.json."""
    return {
        'usable': found.usable, 'reasons': list(found.reasons), 'remarks': list(found.remarks),
        'known': None if found.verdict is None else {
            name: getattr(found.verdict, name)._asdict() for name in ('backlash', 'gain', 'model')
        },
        'm': found.m, 'gap': found.gap, 'c_r': found.c_r, 'c_l': found.c_l,
        'offset': 0.5 * (found.c_r + found.c_l),
        'std': dict(found.std) or dict.fromkeys(('m', 'gap', 'c_r', 'c_l')),
        'numerator': list(found.numerator), 'denominator': list(found.denominator),
        'delay_samples': found.delay, 'equally_good_delays': list(found.delays),
        'integrator': found.integrator, 'sample_period': found.sample_period,
        'output_noise_std': found.noise_std, 'output_quantum': found.quantum,
        'uncertainty': found.uncertainty,
        'response': {
            'frequency_hz': (found.frequencies / (2.0 * np.pi * found.sample_period)).tolist(),
            'relative_std': found.response_std.tolist(),
        },
        'held_out': None if found.details is None else {
            'rms': found.details.held_out.rms,
            'rms_of_fit': found.details.held_out.trained,
        },
        'actuator': None if found.actuator is None else {
            'numerator': found.actuator.lag.numerator.tolist(),
            'denominator': found.actuator.lag.denominator.tolist(),
            'wind_up': list(found.actuator.wind_up),
        },
        'residual': {'lag_one_correlation': found.correlation, 'ljung_box_p': found.ljung_box},
        'samples': len(found.y), 'lost_samples': int(np.isnan(found.y).sum()),
        'outliers': found.outliers,
    }


def commented_yaml(
    parameters: Parameters, found: Identification, source: str, axis: str = '',
) -> str:
    """A parameter file that says of each value what it is and, where it was found, how surely."""
    comments = _found(found)
    head = [
        f'# Identified from {source}: {len(found.y)} samples of {found.sample_period:g} s.',
        f'# {"; ".join(found.remarks)}.' if found.remarks else '# Nothing spoke against it.',
        '# Values with ± were found, the others are as they were given, or defaults.',
    ]
    written = [
        p for p in PARAMETERS
        if p.used_by not in ((BRINGUP,), (RECORDER,)) and parameters[p.name] != ()
        and not p.name.startswith('truth.')
    ]
    of_plant = [p for p in written if p.used_by == (PLANT,)]
    common = [p for p in written if p not in of_plant]
    lines = _section(f'/{axis}/{ANY}' if axis else EVERY_NODE, parameters, common, comments)
    lines.append(('# For simulations alone: the simulated plant is the one that was found.', ''))
    lines += _section(f'/{axis or ANY}/{PLANT}', parameters, of_plant, {})
    if axis:
        lines += [('/bringup:', ''), ('  ros__parameters:', ''), (f"    axes: ['{axis}']", '')]
    return '\n'.join([*head, *(_aligned(text, comment) for text, comment in lines), ''])


def _section(
    name: str, parameters: Parameters, written: list[Parameter], comments: Mapping[str, str],
) -> list[tuple[str, str]]:
    """The lines of one section, with a comment each or none."""
    lines = [(f'{name}:', ''), ('  ros__parameters:', '')]
    groups: list[str] = []
    for parameter in _grouped(written):
        *path, leaf = parameter.name.split('.')
        shared = 0
        while shared < min(len(path), len(groups)) and path[shared] == groups[shared]:
            shared += 1
        for depth in range(shared, len(path)):
            lines.append((f'{"  " * (depth + 2)}{path[depth]}:', ''))
        groups = path
        lines.append((
            f'{"  " * (len(path) + 2)}{leaf}: {yaml_value(parameters[parameter.name])}',
            comments.get(parameter.name) or _described(parameter),
        ))
    return lines


def _grouped(parameters: list[Parameter]) -> list[Parameter]:
    """With the members of each group together, groups in the order of their first member."""
    order: dict[tuple[str, ...], int] = {}
    for place, parameter in enumerate(parameters):
        path = parameter.name.split('.')
        for depth in range(1, len(path) + 1):
            order.setdefault(tuple(path[:depth]), place)
    return sorted(parameters, key=lambda p: [
        order[tuple(p.name.split('.')[:depth + 1])] for depth in range(p.name.count('.') + 1)
    ])


def _aligned(text: str, comment: str) -> str:
    return f'{text.ljust(52)}  # {comment}' if comment else text


def _described(parameter: Parameter) -> str:
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    return f'{parameter.description}{unit}'


def _found(found: Identification) -> dict[str, str]:
    """Comments on what was found."""
    std = found.std
    delays = (
        f'; {found.delays[0]} to {found.delays[-1]} fit alike' if len(found.delays) > 1 else ''
    )
    worst = float(found.response_std.max()) if len(found.response_std) else inf
    hertz = found.frequencies / (2.0 * np.pi * found.sample_period)
    band = f'{hertz[0]:.2g} to {hertz[-1]:.2g} Hz' if len(hertz) else 'no band'
    return {
        'sample_period': 'of the record [s]',
        'plant.numerator': f'G to ± {worst:.2g} of itself from {band}; its gain is that for m = '
                           f'{found.m:g}, ± {std["m"] / found.m:.2g} of itself',
        'plant.denominator': f'{len(found.denominator) - 1} poles'
                             + (', one of them an integrator' if found.integrator else ''),
        'plant.uncertainty': 'twice the deviation of G, and 0.01 at least',
        'control.delay_samples': f'found by comparison{delays}',
        'estimator.initial.m': 'as told with --slope, 1 where it was not: G has the gain for it',
        'estimator.initial.c_r': f'± {std["c_r"]:.2g} [v]',
        'estimator.initial.c_l': f'± {std["c_l"]:.2g} [v]',
        'estimator.output_noise_std': 'deviation of y from the simulation [y]',
        'estimates.file': 'm, c_r, c_l as found, with which the controller begins',
    }

