"""Checks of G(z): what cannot be estimated through it is refused, what is hard is said."""

from __future__ import annotations

import numpy as np

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

ON_CIRCLE = 1e-6  # distance from the unit circle, from 0, or between two roots, that is none


def check_model(model: TransferFunction) -> None:
    """Raise ParameterError where m, c_r, c_l cannot be learned through G, saying why."""
    poles, numerator = model.poles, model.numerator.tolist()
    for pole in poles:
        if abs(pole) > 1.0 + ON_CIRCLE:
            raise ParameterError(
                'plant.denominator', model.denominator.tolist(),
                f'has the unstable pole {_text(pole)}',
                'close a stabilising loop around the plant first and give its G(z)',
            )
    for zero in model.zeros:
        near = poles[np.abs(poles - zero) < ON_CIRCLE]
        if near.size and abs(zero) > 1.0 - ON_CIRCLE:
            raise ParameterError(
                'plant.numerator', numerator,
                f'cancels the pole {_text(near[0])}, which then cannot be seen in y',
                'cancel the common factor in numerator and denominator',
            )
        if abs(zero - 1.0) < ON_CIRCLE:
            raise ParameterError(
                'plant.numerator', numerator,
                'has a zero at z = 1: a constant u leaves no trace in y, nor do c_r and c_l',
                'measure an output that responds to a constant input',
            )


def model_warnings(
    model: TransferFunction, sample_period: float, frequency: float | None = None,
) -> list[str]:
    """Say what makes the estimate ill-conditioned, a sentence each.

    frequency: of the reference [rad/s], if it is known.
    """
    poles = model.poles
    slow = [_text(pole) for pole in poles if ON_CIRCLE < 1.0 - abs(pole) < 1e-4]
    circle = [_text(zero) for zero in model.zeros if abs(abs(zero) - 1.0) < 1e-3]
    samples = 2.0 * np.pi / (frequency * sample_period) if frequency is not None else 100.0
    return [text for true, text in (
        (slow, f'the pole {"".join(slow[:1])} is slower than 10000 samples: sample_period='
               f'{sample_period:g} s is short for this plant'),
        (np.count_nonzero(np.abs(poles - 1.0) < 1e-3) > 1,
         'G(z) integrates more than once: y drifts fast while u is not yet right'),
        (circle, f'the zero {"".join(circle[:1])} lies on the unit circle: motion of u at that '
                 'frequency does not show in y'),
        (np.linalg.cond(StateModel(model).to_observer) > 1e9,
         'the coefficients of G(z) determine its states badly: give more digits, or a longer '
         'sample_period'),
        (not 10.0 <= samples <= 1e5,
         f'frequency={frequency or 0.0:g} rad/s has {samples:.3g} samples per period, between 10 '
         'and 100000 are sensible: change sample_period'),
    ) if true]


def _text(root: complex) -> str:
    return f'{root.real:.6g}' if abs(root.imag) < 1e-9 else f'{root:.6g}'
