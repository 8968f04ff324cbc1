"""Short, seeded versions of what benchmarks/estimation.py measures over many seeds."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
import pytest
from accuracy.cramer_rao import cramer_rao
from accuracy.estimation_runs import (
    EXACT,
    QUIET,
    SeedJob,
    estimates,
    relative_errors,
    run_hour,
    run_random_case,
    run_seed,
    run_wear,
)
from scipy.special import chdtri

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.estimation.moving_horizon.learning import CAPACITY
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop

PAPER = (np.array([1e-5, 4e-5, 1e-5]), np.array([1.0, -2.88504, 2.77196, -0.88692]))
TRUTH = (1.3, 3.0, -3.0)
SEEDS = range(300, 310)
MARKS_S = (2.0, 6.0)


def test_noise_free_example_is_exact_after_one_second() -> None:
    error = relative_errors(build_closed_loop(Parameters(EXACT)).run(601)).max(axis=1)
    assert error[35:].max() <= 0.01
    assert error[100:].max() <= 1e-5


@pytest.mark.parametrize('noise', [1e-4, 1e-3, 1e-2])
def test_errors_are_as_small_as_theory_allows_and_no_larger_than_published(noise: float) -> None:
    results = [
        run_seed(SeedJob(seed, MARKS_S, {'output_noise_std': noise})) for seed in SEEDS
    ]
    normalised = np.array([(r.error / r.bound) ** 2 for r in results])
    # Mean squares of so few seeds scatter: what 1 in 1000 efficient, honest estimators exceeds.
    freedom = len(SEEDS)
    assert normalised.mean(axis=0).max() <= 1.1**2 * chdtri(freedom, 1e-3) / freedom
    nees = np.array([r.nees for r in results]).mean(axis=0)
    assert nees.max() <= chdtri(3 * freedom, 1e-3) / freedom
    assert nees.min() >= chdtri(3 * freedom, 1.0 - 1e-3) / freedom


def test_random_plants_gaps_and_first_guesses_end_within_two_per_cent() -> None:
    results = [run_random_case(seed) for seed in range(9000, 9024)]
    assert [r for r in results if r.trouble] == []
    kept = [r for r in results if r.bound.max() <= 0.005]
    assert len(kept) >= 6
    assert [r for r in kept if r.error.max() > 0.02] == []


def run_with_search_at(search_at: Callable[[int], bool], samples: int) -> Estimate:
    """The estimate of a controller that has the time to search on at these samples alone."""
    p = Parameters({'output_noise_std': 1e-3, 'seed': 3})
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    for k in range(samples):
        step = controller.step(plant.measure(), reference(k * p.get_float('sample_period')))
        if search_at(k):
            controller.refine()
        plant.step(step.v)
    return controller.estimator.estimate


def test_search_that_has_to_wait_again_and_again_finds_the_gap() -> None:
    estimate = run_with_search_at(lambda k: k % 5 == 0, 600)
    assert estimate.status == Status.TRACKING
    assert (estimate.m, estimate.c_r, estimate.c_l) == pytest.approx(TRUTH, rel=5e-3)


def test_record_that_is_full_before_there_was_time_to_read_it_does_no_harm() -> None:
    estimate = run_with_search_at(lambda k: k < 60 or k > CAPACITY + 100, CAPACITY + 500)
    assert estimate.status == Status.TRACKING
    assert (estimate.m, estimate.c_r, estimate.c_l) == pytest.approx(TRUTH, rel=5e-3)


def test_losing_a_fifth_of_y_costs_no_more_than_its_information() -> None:
    changes = {'output_noise_std': 1e-3}
    lossy = {**changes, 'output_loss': 0.2}
    whole = [run_seed(SeedJob(seed, (2.0,), changes)).error for seed in SEEDS]
    thinned = [run_seed(SeedJob(seed, (2.0,), lossy)).error for seed in SEEDS]
    ratio = np.sqrt(np.mean(np.square(thinned)) / np.mean(np.square(whole)))
    # Other errors, not larger ones: their ratio scatters by about 1 / sqrt(seeds).
    assert ratio <= sqrt(1.0 / 0.8) * 1.1 * (1.0 + 1.0 / sqrt(len(SEEDS)))


def test_quantised_output_still_gives_two_per_mille_after_one_second() -> None:
    run = build_closed_loop(Parameters({**EXACT, 'output_quantum': 1e-3})).run(101)
    assert relative_errors(run)[-1].max() <= 0.002


@pytest.mark.parametrize('seed', [1, 2])
def test_wear_and_a_step_of_a_crossing_are_followed(seed: int) -> None:
    result = run_wear(SeedJob(seed, changes={
        'output_noise_std': 1e-3, 'estimator.drift_std': (0.01, 0.01, 0.01),
    }))
    assert result.m <= 0.02
    assert max(result.c_r) <= 0.03


@pytest.mark.parametrize('what', QUIET)
def test_estimates_freeze_while_v_stays_within_the_gap(what: str) -> None:
    result = run_hour((what, 2500))
    assert result.always_frozen
    assert result.moved == 0.0
    assert result.finite


@pytest.mark.parametrize(('changes', 'learns'), [
    ({'waveform': 'triangle', 'bias': 7.0}, True),
    ({'waveform': 'chirp'}, True),
    ({'waveform': 'square', 'proportional.f': 0.0, 'output_noise_std': 1e-3}, False),
    ({'estimator.initial.m': 0.13, 'estimator.initial.c_r': 0.3, 'estimator.initial.c_l': -30.0},
     True),
    ({
        'sample_period': 0.001, 'plant.denominator': (1.0, -2.98805183, 2.97612354, -0.98807171),
        'plant.numerator': (1.994012e-7, 7.952171e-7, 1.982084e-7), 'amplitude': 20.0,
    }, True),
], ids=['triangle with bias', 'chirp', 'square', 'first guess off by 10', '1 kHz'])
def test_ill_conditioned_data_neither_break_the_filters_nor_mislead(
    changes: dict[str, object], learns: bool,
) -> None:
    p = Parameters(changes)
    run = build_closed_loop(p).run(1000)
    assert np.isfinite(run.rows[:, :10]).all()
    assert (run.column('status')[-1] == Status.TRACKING) == learns
    if learns:
        # Rounding would delay the first estimate at 1 kHz: y is small beside what integrates.
        assert (run.column('status')[:500] == Status.TRACKING).any()
        std = np.array([run.column(f'std_{name}')[-1] for name in ('m', 'c_r', 'c_l')])
        error = np.abs(estimates(run)[-1] - TRUTH)
        assert np.all(error <= 5.0 * std + 1e-5 * np.abs(TRUTH))


def test_bound_of_the_benchmark_equals_the_inverse_of_a_numerical_information_matrix() -> None:
    v = 10.0 * np.sin(0.126 * np.arange(150))
    found = cramer_rao(v, *PAPER, TRUTH, 1e-3)
    sensitivity = np.column_stack([
        (_output(v, unknowns + step) - _output(v, unknowns - step)) / (2.0 * step.max())
        for unknowns, step in ((UNKNOWNS, 1e-4 * axis) for axis in np.eye(7))
    ])
    expected = 1e-3 * np.sqrt(np.diag(np.linalg.inv(sensitivity.T @ sensitivity)))
    assert found == pytest.approx(expected[:3], rel=1e-4)


UNKNOWNS = np.array([*TRUTH, 0.0, 0.01, 0.01, 0.01])  # and u and the state at the start


def _output(v: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """y(0..N) of the example, simulated sample by sample from the paper's equations."""
    m, c_r, c_l, u, *x = unknowns
    numerator, denominator = PAPER
    y = []
    for value in [*v, 0.0]:
        y.append(x[0])
        u = min(max(u, m * (value - c_r)), m * (value - c_l))
        x = [x[1] - denominator[1] * x[0] + numerator[0] * u,
             x[2] - denominator[2] * x[0] + numerator[1] * u,
             -denominator[3] * x[0] + numerator[2] * u]
    return np.array(y)
