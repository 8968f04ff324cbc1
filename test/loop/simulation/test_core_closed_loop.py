"""The whole loop in one process: what the project promises."""

import numpy as np
import pytest
from strategies import output_of, paper_example

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.run_record import control_error_rms, settling_time


def test_lms_learns_the_papers_backlash_to_1_percent_within_5_s() -> None:
    run = build_closed_loop(paper_example()).run(1000)
    for name in ('m', 'c_r', 'c_l'):
        time = settling_time(run.column('t'), run.column(name), run.column(f'true_{name}'))
        assert time is not None, f'{name} ends at {run.column(name)[-1]}'
        assert time <= 5.0, name
    error = control_error_rms(run)
    assert error is not None
    assert error < 1e-3


def test_row_holds_the_signals_of_one_sample() -> None:
    loop = build_closed_loop(paper_example())
    run = loop.run(300)
    t, y_m, u_d, v, u = (run.column(name) for name in ('t', 'y_m', 'u_d', 'v', 'u'))
    np.testing.assert_allclose(t, 0.01 * np.arange(300))
    np.testing.assert_allclose(y_m, 10.0 * np.sin(12.6 * t))
    np.testing.assert_allclose(u_d, y_m + run.column('f') * v, atol=1e-9)  # (3.2)
    assert (u <= 1.3 * (v + 3.0) + 1e-9).all()
    assert (u >= 1.3 * (v - 3.0) - 1e-9).all()
    model = TransferFunction((1e-5, 4e-5, 1e-5), (1.0, -2.88504, 2.77196, -0.88692))
    np.testing.assert_allclose(run.column('y'), output_of(model, u), atol=1e-9)
    assert run.has_truth


@pytest.mark.parametrize(('law', 'structure'), [
    ('moving_horizon', 'proportional'), ('moving_horizon', 'tracking'), ('lms', 'proportional'),
    ('printed', 'proportional'), ('fixed', 'tracking'), ('gradient', 'pole_placement'),
])
@pytest.mark.parametrize('size', [5e-324, 1e-155, 1e-130])
def test_commands_whose_square_is_hardly_a_number_are_harmless(law, structure, size):
    parameters = Parameters({'estimator.law': law, 'structure': structure})
    loop = build_closed_loop(parameters).controller
    for k in range(200):
        # The plant is moved by something else.
        y, applied = np.sin(0.05 * k), [size * (k % 15 - 7)] if k else []
        step = loop.step(y, size * (k % 20 - 10), 0, applied)
        loop.refine()
        estimate = loop.estimator.estimate
        assert np.all(np.isfinite([step.v, estimate.m, estimate.c_r, estimate.c_l]))
