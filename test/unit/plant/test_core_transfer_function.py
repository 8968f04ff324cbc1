"""G(z) and its state space, against scipy.signal."""


import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from strategies import output_of, plants

from backlash_ros.core.plant.transfer_function import TransferFunction


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
