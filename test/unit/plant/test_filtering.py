"""The filter of this package against that of SciPy."""

import numpy as np
import pytest
from scipy.signal import lfilter as scipy_lfilter

from backlash_ros.core.plant.filtering import lfilter

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
