"""u reconstructed from y alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR, output_of, plants

from backlash_ros.core.laws.input_reconstruction import InputReconstruction
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = np.ndarray
LAG = 30
PAPER = TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)


def play_output(samples: int = 400) -> Array:
    return np.clip(14.0 * np.sin(0.126 * np.arange(samples)), -10.0, 10.0)


def reconstructed(
    reconstruction: InputReconstruction, y: Array, lost: tuple[int, ...] = (),
) -> Array:
    """u_hat, shifted so that element k belongs to u(k); nan where y is too short."""
    lagged = [reconstruction.update(None if k in lost else float(y[k])) for k in range(len(y))]
    result = np.full(len(y), np.nan)
    result[: len(y) - reconstruction.lag] = lagged[reconstruction.lag:]
    return result


def error(model: TransferFunction, noise_std: float = 0.0, lag: int = LAG,
          lost: tuple[int, ...] = (), samples: int = 400) -> Array:
    """u_hat(k) - u(k) from k = 2 lag on, as long as y reaches."""
    u = play_output(samples)
    u_hat = reconstructed(InputReconstruction(model, noise_std, lag), output_of(model, u), lost)
    return (u_hat - u)[2 * lag: samples - lag]


@given(model=plants())
def test_u_is_exact_after_the_lag_without_noise(model: TransferFunction) -> None:
    assert np.abs(error(model)).max() < 1e-3


@given(model=plants(), lost=st.sets(st.integers(100, 140), max_size=10))
def test_lost_samples_do_not_put_it_out_of_step(model: TransferFunction, lost: set[int]) -> None:
    late = error(model, lost=tuple(lost), samples=600)[300:]
    assert np.abs(late).max() < 1e-3


@pytest.mark.parametrize('noise_std', [1e-4, 1e-3])
def test_it_is_the_least_squares_solution_of_random_walk_and_noise(noise_std: float) -> None:
    """Against one batch solution over all samples, which knows no recursion."""
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
        rcond=None,
    )
    recursion = InputReconstruction(PAPER, noise_std, lag)
    for value in y:
        recursion.update(float(value))
    assert recursion.u_hat == pytest.approx(batch[samples - 1 - lag], abs=1e-3)


def test_lag_shorter_than_the_delay_of_the_plant_is_refused() -> None:
    """y(k) cannot tell u(k - 3) yet when it takes u five samples to reach y."""
    model = TransferFunction([1.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ParameterError) as refusal:
        InputReconstruction(model, 0.0, 3)
    assert refusal.value.name == 'estimator.lag'
    InputReconstruction(model, 0.0, 5)
