"""What the ideal trajectory of the tracking structure promises of y, without any backlash."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import plants

from backlash_ros.core.control.tracking.design import power_gain
from backlash_ros.core.control.tracking.lq_preview import PreviewGains, preview_gains
from backlash_ros.core.plant.transfer_function import StateModel


def gains_of(
    model: StateModel, weight: float, integral_weight: float = 0.0, window: int = 60,
) -> PreviewGains:
    rho = weight * power_gain(model.transfer_function, np.pi / 10.0)
    return preview_gains(model, rho, integral_weight, window)


def gain_at_rest(model: StateModel, gains: PreviewGains) -> float:
    """y at rest for r = 1: (I - A + B K) x = -B sum f."""
    n = model.order
    closed = np.zeros((n + 1, n + 1))
    closed[:n, :n] = model.a - np.outer(model.b, gains.state)
    closed[:n, n] = -gains.integral * model.b
    closed[n, 0], closed[n, n] = -model.c, 1.0
    driven = np.append(-model.b * gains.preview.sum(), 1.0)
    if not gains.integral:
        closed, driven = closed[:n, :n], driven[:n]
    return float(model.c * np.linalg.solve(np.eye(len(driven)) - closed, driven)[0])


@given(
    model=plants(), weight=st.floats(1e-4, 100.0), window=st.integers(0, 80),
    integral_weight=st.sampled_from([0.0, 1e-4, 1e-2]),
)
def test_the_trajectory_comes_to_rest_at_the_reference(model, weight, window, integral_weight):
    state = StateModel(model)
    gains = gains_of(state, weight, integral_weight, window)
    assert gain_at_rest(state, gains) == pytest.approx(1.0, abs=1e-6)
