"""The four-block structure: gains from the Diophantine equation, and the loop they make."""

import numpy as np
import pytest
from scipy import signal
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.assembly import build_four_blocks, build_structure
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.four_blocks import place_poles
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop

PAPER = TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)


def answer(model: TransferFunction, u: np.ndarray) -> np.ndarray:
    return signal.lfilter(model.numerator, model.denominator, u)


@pytest.mark.parametrize('filter_pole', [0.0, 0.6, 0.9])
def test_loop_without_backlash_answers_as_the_reference_model_says(filter_pole: float) -> None:
    p = Parameters({
        'structure': 'pole_placement', 'pole_placement.filter_pole': filter_pole,
        'estimator.law': 'fixed', 'estimator.initial.m': 1.3, 'estimator.initial.c_r': 0.0,
        'estimator.initial.c_l': 0.0, 'backlash.c_r': 1e-12, 'backlash.c_l': -1e-12,
        'amplitude': 0.2,
    })
    run = build_closed_loop(p).run(300)
    blocks = place_poles(PAPER, closed_of(p), filter_pole)
    np.testing.assert_allclose(
        run.column('y'), answer(blocks.reference, run.column('y_m')), atol=1e-6
    )
    ramp = np.arange(400.0)
    late = ramp[-1] - answer(blocks.reference, ramp)[-1]
    assert build_structure(p).delay == round(late) > 0


def closed_of(p: Parameters) -> np.ndarray:
    return build_four_blocks(p).reference.denominator


def test_common_factor_of_numerator_and_denominator_is_refused() -> None:
    model = TransferFunction([1.0, -0.5], [1.0, -1.4, 0.45])
    with pytest.raises(ParameterError, match='common factors'):
        place_poles(model, np.array([1.0, -0.6, 0.09]), 0.3)
