"""Filter, Riccati and Lyapunov equations beside those of SciPy, which no controller loads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import linalg
from scipy.signal import lfilter as scipy_lfilter

from backlash_ros.core.plant.numerics import lfilter, lyapunov, riccati
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

LEARNS = """
import sys
import time
from math import sin
from backlash_ros.core.assembly import WORKER_MODULES, build_controller, build_plant
from backlash_ros.core.jobs.worker import WorkerExecutor
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
