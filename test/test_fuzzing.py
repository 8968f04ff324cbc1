"""Random messages, calls and parameters; test/fuzzing.py does the same for as long as one likes."""

from __future__ import annotations

import pytest
from fuzzing import fuzz


@pytest.mark.parametrize('seed', range(1, 13))
def test_whatever_comes_the_commands_stay_finite_and_within_the_limits(seed: int) -> None:
    assert fuzz(seed, 15) == 15
