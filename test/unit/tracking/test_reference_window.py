"""The references that the tracking structure looks at, and what is kept of the past."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.control.tracking.reference_window import ReferenceWindow, averages


def taken(window: ReferenceWindow, value: float) -> np.ndarray:
    window.append(value)
    window.settle()
    return window.window


@given(
    preview=st.integers(0, 5), history=st.integers(0, 7),
    values=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=80),
)
def test_window_and_past_are_the_last_values_in_order(preview, history, values):
    window = ReferenceWindow(preview, history, np.ones(len(averages(preview))))
    assert window.empty
    window.fill(7.0)
    known = deque([7.0] * (preview + 1), maxlen=history + preview + 1)
    for value in values:
        known.append(value)
        assert taken(window, value).tolist() == list(known)[-preview - 1:]
        assert [window.low, window.high] == [min(window.window), max(window.window)]
        assert window.all().tolist() == list(known)
    assert not window.empty


def followed(values: np.ndarray, preview: int = 60) -> np.ndarray:
    """r(k) as the trajectory takes it, of references that come one by one."""
    window = ReferenceWindow(preview, 10, np.ones(len(averages(preview))))
    window.fill(float(values[0]))
    return np.array([taken(window, value).item(0) for value in values.tolist()])[preview:]


K = np.arange(3000.0)
CLEAN = {
    'slow': np.sin(0.005 * K), 'fast': np.sin(0.2 * K), 'steps': np.sign(np.sin(0.03 * K + 0.01)),
    'moves': np.clip(np.cumsum(0.02 * np.sign(np.sin(0.01 * K)) * (np.sin(0.04 * K) > 0)), -5, 5),
}


@pytest.mark.parametrize('name', CLEAN)
def test_references_without_noise_stay_what_they_are(name: str) -> None:
    assert followed(CLEAN[name]) == pytest.approx(CLEAN[name][:-60], abs=1e-9)


@pytest.mark.parametrize(('name', 'left'), [('slow', 0.35), ('fast', 0.9), ('steps', 0.6)])
def test_noise_of_references_is_averaged_as_far_as_they_are_smooth(name: str, left: float) -> None:
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(K))
    error = followed(CLEAN[name] + noise)[200:] - CLEAN[name][200:-60]
    assert error.std() < left * 0.01


def test_a_step_is_not_smeared_by_averaging_noise() -> None:
    noise = 0.01 * np.random.default_rng(1).standard_normal(400)
    step = np.where(np.arange(400) < 250, 0.0, 1.0)
    assert np.abs(followed(step + noise)[150:] - step[150:-60]).max() < 0.05
