"""Laws beside the default one: (3.11) as printed, the gradient law, u reconstructed from y."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR, KnownInput, eighths, output_of, plants

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.laws.input_reconstruction import InputReconstruction
from backlash_ros.core.laws.lms_and_printed import PrintedLaw, printed_c, printed_f, printed_m
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop

SMALL = eighths(-80, 80)


@given(u=SMALL, y_m=SMALL, m=eighths(1, 80), w=SMALL)
def test_printed_f_reduces_to_the_solution_of_e_equal_0(u, y_m, m, w):
    assume(y_m + m * w != 0.0 and u + m * w != 0.0)
    reduced = Fraction(m) * (Fraction(u) - Fraction(y_m)) / (Fraction(u) + Fraction(m * w))
    assert printed_f(u, y_m, m, w) == float(reduced)


@given(u=SMALL, y_m=SMALL, f=eighths(-80, 80), w=SMALL)
def test_printed_m_reduces_to_the_solution_of_e_equal_0(u, y_m, f, w):
    assume(f != 0.0 and y_m + f * w != 0.0 and u - y_m - f * w != 0.0)
    assert printed_m(u, y_m, f, w) == float(Fraction(u) * Fraction(f) / Fraction(u - y_m - f * w))


@given(u=SMALL, y_m=SMALL, f=eighths(-80, 80), m=eighths(1, 80))
def test_printed_c_reduces_to_the_solution_of_e_equal_0(u, y_m, f, m):
    assume(f != 0.0)
    reduced = (Fraction(u) - Fraction(y_m)) / Fraction(f) - Fraction(u) / Fraction(m)
    assert printed_c(u, y_m, f, m) == float(reduced)


@given(data=st.lists(st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0)), max_size=40))
def test_guarded_law_stays_finite_and_within_its_bounds(data: list[tuple[float, float]]) -> None:
    bounds = Parameters().estimator.bounds
    estimator = PrintedLaw(Estimate(0.696, 0.5, -0.5, 0.22), bounds, (-0.5, 0.5), KnownInput())
    # The paper's first sample, u = y_m = 0, leads to 0/0 in m and c.
    for u, y_m in [(0.0, 0.0), *data]:
        estimator.update(u, Interval(v=0.0, y_m=y_m, u_d=0.0))
        e = estimator.estimate
        assert bounds.m[0] <= e.m <= bounds.m[1]
        assert bounds.c_r[0] <= e.c_r <= bounds.c_r[1]
        assert bounds.c_l[0] <= e.c_l <= bounds.c_l[1]
        assert -0.5 <= e.f <= 0.5


TRUTH = {'m': 1.3, 'c_r': 3.0, 'c_l': -3.0}


def four_blocks(**changes: object) -> Parameters:
    named = {name.replace('__', '.'): value for name, value in changes.items()}
    return Parameters({
        'structure': 'pole_placement', 'estimator.law': 'gradient', 'amplitude': 0.2, **named})


@pytest.mark.parametrize('amplitude', [0.05, 0.2, 1.0])
def test_learns_all_three_from_the_tracking_error(amplitude: float) -> None:
    run = build_closed_loop(four_blocks(amplitude=amplitude)).run(2000)
    assert {name: run.column(name)[-1] for name in TRUTH} == pytest.approx(TRUTH, rel=0.01)


def test_says_that_y_moves_against_v() -> None:
    p = four_blocks()
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    for k in range(200):
        step = controller.step(-plant.measure(), reference(k * 0.01))
        plant.step(step.v)
    assert step.estimate.status is Status.INCONSISTENT


LAG = 30
PAPER = TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)


def error(model: TransferFunction, lost: set[int] = frozenset(), samples: int = 400) -> np.ndarray:
    u = np.clip(14.0 * np.sin(0.126 * np.arange(samples)), -10.0, 10.0)
    smoother = InputReconstruction(model, 0.0, LAG)
    late = [smoother.update(None if k in lost else float(y))
            for k, y in enumerate(output_of(model, u))]
    return np.array(late[3 * LAG:]) - u[2 * LAG:samples - LAG]


@given(model=plants())
def test_u_is_exact_after_the_lag_without_noise(model: TransferFunction) -> None:
    assert np.abs(error(model)).max() < 1e-3


@given(model=plants(), lost=st.sets(st.integers(100, 140), max_size=10))
def test_lost_samples_do_not_put_it_out_of_step(model: TransferFunction, lost: set[int]) -> None:
    assert np.abs(error(model, lost, 600)[300:]).max() < 1e-3


@pytest.mark.parametrize('noise_std', [1e-4, 1e-3])
def test_it_is_the_least_squares_solution_of_random_walk_and_noise(noise_std: float) -> None:
    samples, lag = 200, 20
    rng = np.random.default_rng(3)
    y = output_of(PAPER, np.cumsum(rng.standard_normal(samples)))
    y += noise_std * rng.standard_normal(samples)
    impulse = output_of(PAPER, np.eye(1, samples)[0])
    response = np.array([[impulse[i - j] if i >= j else 0.0 for j in range(samples)]
                         for i in range(samples)])
    walk = np.eye(samples) - np.eye(samples, k=-1)
    batch, *_ = np.linalg.lstsq(
        np.vstack([response / noise_std, walk]), np.append(y / noise_std, np.zeros(samples)),
        rcond=None)
    recursion = InputReconstruction(PAPER, noise_std, lag)
    for value in y:
        recursion.update(float(value))
    assert recursion.u_hat == pytest.approx(batch[samples - 1 - lag], abs=1e-3)


def test_lag_shorter_than_the_delay_of_the_plant_is_refused() -> None:
    model = TransferFunction([1.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ParameterError) as refusal:
        InputReconstruction(model, 0.0, 3)
    assert refusal.value.name == 'estimator.lag'
    InputReconstruction(model, 0.0, 5)


@pytest.mark.parametrize('start', [1.0, 1e4])
def test_state_of_g_is_found_however_large_y_is_beside_its_noise(start: float) -> None:
    model, noise_std = StateModel(TransferFunction([0.1, 0.05], [1.0, -1.5, 0.6, -0.05])), 1e-3
    law = FixedBacklash(Estimate(1.0, 0.0, 0.0, 0.0), model, noise_std, 0.1)
    rng, x = np.random.default_rng(5), model.equilibrium * start
    u = ((x - model.a @ x) @ model.b) / (model.b @ model.b)  # holds y at start
    for k in range(60):
        law.update(model.c * x[0] + noise_std * rng.normal(), Interval(u, 0.0, 0.0))
        off, std = np.abs(law.x_hat - x), np.sqrt(law.x_cov.diagonal())
        assert (off < 5.0 * std + 1e-14 * start).all(), k
        x = model.a @ x + model.b * u
