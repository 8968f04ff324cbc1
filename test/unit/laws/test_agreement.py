"""How laws without deviations judge their estimates."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimate import Status
from backlash_ros.core.laws.agreement import LEAST_SAMPLES, MEMORY, Agreement


@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-6, 6))
def test_samples_that_leave_a_direction_open_decide_nothing(seed: int, exponent: int) -> None:
    # As behind a filter that answers alike to v and to the side: their products are singular.
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((MEMORY, 2)) @ rng.standard_normal((2, 3))
    t = rng.standard_normal(MEMORY)
    agreement = Agreement()
    for row in 10.0**exponent * np.column_stack([phi, t]):
        assert agreement.take(row.tolist(), 1.0, 1.0, -1.0) is Status.ACQUIRING


@given(seed=st.integers(0, 2**32 - 1), m=st.sampled_from([-1.0, 1.0]))
def test_samples_that_tell_all_three_decide(seed: int, m: float) -> None:
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((LEAST_SAMPLES, 3))
    agreement = Agreement()
    for row in np.column_stack([phi, m * (phi @ [1.0, 1.0, -1.0])]):
        status = agreement.take(row.tolist(), 1.0, 1.0, -1.0)
    assert status is (Status.TRACKING if m > 0.0 else Status.INCONSISTENT)
