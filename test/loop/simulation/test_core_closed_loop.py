"""The whole loop in one process: what the project promises."""

from collections.abc import Callable

import numpy as np
import pytest
from strategies import output_of, paper_example

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.metrics import control_error_rms, settling_time
from backlash_ros.core.simulation.run_record import RunRecord

TEN_SECONDS = 1000
NAMES = ('m', 'c_r', 'c_l')


def settled(run: RunRecord) -> list[float | None]:
    """When m, c_r and c_l came within 1 % of the truth for good."""
    return [
        settling_time(run.column('t'), run.column(name), run.column(f'true_{name}'))
        for name in NAMES
    ]


def assert_settled_within(run: RunRecord, seconds: float) -> None:
    for name, time in zip(NAMES, settled(run), strict=True):
        assert time is not None, f'{name} ends at {run.column(name)[-1]}'
        assert time <= seconds, name


def test_lms_learns_the_papers_backlash_to_1_percent_within_5_s() -> None:
    run = build_closed_loop(paper_example()).run(TEN_SECONDS)
    assert_settled_within(run, 5.0)
    error = control_error_rms(run)
    assert error is not None
    assert error < 1e-3


def every(period: int, burst: int = 1) -> Callable[[], bool]:
    """A pattern that loses the last `burst` outputs of each period."""
    count = 0

    def lose() -> bool:
        nonlocal count
        count += 1
        return count % period >= period - burst

    return lose


@pytest.mark.parametrize(('period', 'burst'), [(50, 1), (20, 1), (40, 3)])
def test_lms_learns_although_outputs_are_lost(period: int, burst: int) -> None:
    """The plant goes on with the held v through every loss."""
    loop = build_closed_loop(paper_example())
    loop.lose = every(period, burst)
    run = loop.run(TEN_SECONDS)
    assert run.lost_samples == TEN_SECONDS - run.samples > 0
    assert_settled_within(run, 5.0)


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


def test_one_seed_gives_one_run_to_the_last_bit() -> None:
    def rows(seed: int) -> np.ndarray:
        p = paper_example(seed=seed, output_noise_std=1e-3, output_loss=0.1)
        return build_closed_loop(p).run(200).rows

    assert np.array_equal(rows(3), rows(3), equal_nan=True)
    assert rows(3).shape != rows(4).shape or not np.array_equal(rows(3), rows(4), equal_nan=True)


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
