"""Random messages, calls, parameters and faults; fuzzing.py and fuzzing_loops.py do more of it."""

from __future__ import annotations

import pytest
from fuzzing import fuzz
from fuzzing_loops import fuzz_loop


@pytest.mark.parametrize('seed', range(1, 13))
def test_whatever_comes_the_commands_stay_finite_and_within_the_limits(seed: int) -> None:
    assert fuzz(seed, 15) > 100  # commands, each of which was looked at


@pytest.mark.parametrize('seed', [10, 33, 52, 98, 134])
@pytest.mark.filterwarnings('error')
def test_no_fault_that_comes_and_goes_breaks_the_arithmetic(seed: int) -> None:
    assert fuzz_loop(seed) > 100  # likewise
