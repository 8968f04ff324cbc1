"""G(z) against SciPy, which one is refused or warned of, and the equations solved for it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, signal
from scipy.signal import lfilter as scipy_lfilter
from strategies import output_of, plants

from backlash_ros.core.assembly import build_controller, takes_model_as_exact, warnings_of
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.numerics import lfilter, lyapunov, riccati
from backlash_ros.core.plant.quantized import step_of
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction


@given(model=plants(), seed=st.integers(0, 1000))
def test_state_space_and_simulation_agree_with_scipy(model: TransferFunction, seed: int) -> None:
    u = np.random.default_rng(seed).uniform(-1.0, 1.0, 60)
    _, expected = signal.dlsim((np.trim_zeros(model.numerator, 'f'), model.denominator, 1.0), u)
    a, b, c = model.state_space()
    x, by_states = np.zeros(model.order), []
    for value in u:
        by_states.append(c @ x)
        x = a @ x + b * value
    size = np.abs(expected).max() + 1.0
    np.testing.assert_allclose(by_states, expected[:, 0], atol=1e-8 * size)
    np.testing.assert_allclose(output_of(model, u), expected[:, 0], atol=1e-8 * size)


@given(model=plants())
def test_frequency_response_agrees_with_scipy(model: TransferFunction) -> None:
    w, expected = signal.freqz(model.numerator, model.denominator, np.linspace(0.1, 3.1, 30))
    np.testing.assert_allclose(model.response(np.exp(1j * w)), expected, rtol=1e-6, atol=1e-12)


def plant(numerator: list[float], denominator: list[float], **more: object) -> Parameters:
    return Parameters({'plant.numerator': numerator, 'plant.denominator': denominator, **more})


@pytest.mark.parametrize(('numerator', 'denominator', 'reason'), [
    ([1.0], [1.0, -1.2], 'unstable pole 1.2: turn it around if its powers of z ascend'),
    ([1.0, -1.0], [1.0, -0.5, 0.06], 'zero at z = 1'),
    ([1.0, -1.0], [1.0, -1.5, 0.5], 'cancels the pole 1'),
])
def test_plant_through_which_nothing_can_be_learned_is_refused(numerator, denominator, reason):
    with pytest.raises(ParameterError, match=reason):
        build_controller(plant(numerator, denominator))


@pytest.mark.parametrize(('parameters', 'reason'), [
    (plant([1.0], [1.0, -0.99999]), 'slower than'),
    (plant([1.0], [1.0, -2.0, 1.0]), 'integrates more than once'),
    (plant([1.0, 1.0], [1.0, -0.5, 0.06]), 'on the unit circle'),
    (Parameters({'frequency': 300.0}), 'samples per period'),
])
def test_plant_that_makes_it_hard_is_warned_of(parameters: Parameters, reason: str) -> None:
    assert any(reason in warning for warning in warnings_of(parameters))


def test_the_example_is_neither_refused_nor_warned_of() -> None:
    build_controller(Parameters())
    assert warnings_of(Parameters()) == []


@pytest.mark.parametrize(('changes', 'exact'), [
    ({'plant.uncertainty': 0.0}, False),  # the paper assumes it of its example
    ({'plant.uncertainty': 0.0, 'plant.numerator': [2e-5, 4e-5, 1e-5]}, True),
    ({'plant.numerator': [2e-5, 4e-5, 1e-5]}, False),
    ({'plant.uncertainty': 0.0, 'plant.numerator': [2e-5, 4e-5, 1e-5],
      'estimator.law': 'fixed'}, False),
])
def test_a_model_that_is_taken_as_exact_is_known(changes, exact):
    assert takes_model_as_exact(Parameters(changes)) is exact


LEARNS = """
import sys
import time
from math import sin
import backlash_ros.nodes.controller
from backlash_ros.core.assembly import WORKER_MODULES, build_controller, build_plant
from backlash_ros.core.jobs import WorkerExecutor
from backlash_ros.core.parameters import Parameters
p = Parameters({
    'structure': 'tracking', 'output_noise_std': 1e-3, 'sample_period': 0.01,
    'plant.numerator': [0.1], 'plant.denominator': [1.0, -1.7, 0.8], 'plant.uncertainty': 0.2,
    'truth.numerator': [0.11], 'truth.denominator': [1.0, -1.68, 0.79]})
controller, plant = build_controller(p, executor=WorkerExecutor(WORKER_MODULES)), build_plant(p)
while controller.redesign.adopted is None:  # until a better G is in use
    step = controller.step(plant.measure(), 8.0 * sin(0.1 * plant.sample))
    controller.refine()
    plant.step(step.v)
    time.sleep(0.001)  # for the worker
controller.close()
print([name for name in sys.modules if name.startswith('scipy')])
"""

A = [1.0, -2.88504, 2.77196, -0.88692]


@pytest.mark.parametrize('shape', [(200,), (4, 60), (2, 3, 60), (1,), (2,), (3, 2)])
@pytest.mark.parametrize(('b', 'a'), [
    ([1.0], A), ([0.0, 1e-5, 4e-5, 1e-5], A), ([0.5, 0.2, -0.1, 0.3, 1.0], [2.0, -1.0]),
    ([0.3, 0.1], [1.0]), ([2.0], [1.0]), ([1.0, 0.5], [1.0, -0.9, 0.2]),
])
def test_filter_is_that_of_scipy(shape: tuple[int, ...], b: list[float], a: list[float]) -> None:
    rng = np.random.default_rng(4)
    x = rng.normal(size=shape)
    state = rng.normal(size=(*shape[:-1], max(len(a), len(b)) - 1))
    np.testing.assert_allclose(lfilter(b, a, x), scipy_lfilter(b, a, x), rtol=1e-9, atol=1e-9)
    if state.shape[-1]:
        expected = scipy_lfilter(b, a, x, zi=state)[0]
        np.testing.assert_allclose(lfilter(b, a, x, state), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('denominator', [
    [1.0, -1.25, 0.53], [1.0, -1.9, 0.9], [1.0, -2.0, 1.0],
    np.poly([0.9999, 0.95, 0.2 + 0.3j, 0.2 - 0.3j, 0.0]).real.tolist(),
])
@pytest.mark.parametrize('weight', [1e-4, 1.0, 1e4])
def test_the_solution_stabilises_and_solves(denominator: list[float], weight: float) -> None:
    model = StateModel(TransferFunction([0.1, 0.05], denominator))
    a, b = model.a, model.b * weight**-0.5
    q = np.zeros((model.order, model.order))
    q[0, 0] = model.c**2
    p = riccati(a, b, q)
    gain = b @ p @ a / (1.0 + b @ p @ b)
    assert np.abs(np.linalg.eigvals(a - np.outer(b, gain))).max() < 1.0
    assert a.T @ p @ a - np.outer(a.T @ p @ b, gain) + q == pytest.approx(p, rel=1e-9, abs=1e-9)
    known = linalg.solve_discrete_are(a, b[:, None], q, np.eye(1))
    assert p == pytest.approx(known, rel=1e-6, abs=1e-6 * float(np.abs(known).max()))
    stable = a - np.outer(b, gain)
    known = linalg.solve_discrete_lyapunov(stable, q)
    assert lyapunov(stable, q) == pytest.approx(known, rel=1e-6, abs=1e-9)


def test_what_has_no_solution_is_refused() -> None:
    unstable, nothing = np.diag([1.1, 0.5]), np.array([0.0, 1.0])
    with pytest.raises(np.linalg.LinAlgError):
        riccati(unstable, nothing, np.eye(2))
    with pytest.raises(np.linalg.LinAlgError):
        lyapunov(unstable, np.eye(2))


def test_a_controller_whose_fits_are_made_elsewhere_does_not_load_scipy() -> None:
    done = subprocess.run([sys.executable, '-c', LEARNS], capture_output=True, text=True)
    assert done.stdout.strip() == '[]', done.stdout + done.stderr


@pytest.mark.parametrize(('moves', 'step'), [
    ([7, 2, 9, 1, 40, 25, 6, 11, 5], 0.25), ([35, 10, 45, 14, 40, 25, 6, 55, 77], 0.25),
    (np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23]), 0.0),
])
def test_the_step_of_readings_is_found_though_none_are_that_close(moves, step):
    assert step_of(0.1 + 0.25 * np.cumsum(moves)) == pytest.approx(step, abs=1e-9)
