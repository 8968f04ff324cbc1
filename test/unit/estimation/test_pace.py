"""The size of the pieces of a fit follows the processor time that they take."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimation.fit.pace import LARGEST, LONG, SLOWEST, Pace

BUDGET_S = 1e-3


def settled(overhead_s: float, per_sample_s: float) -> Pace:
    """After many pieces that take so long."""
    pace = Pace()
    for _ in range(40):
        size = pace.pieces(1)
        pace.note(overhead_s + size * per_sample_s, BUDGET_S)
    return pace


@given(st.floats(1e-6, 0.1 * BUDGET_S), st.floats(1e-9, 1e-6))
def test_pieces_are_as_large_as_fits_into_the_budget(overhead: float, per_sample: float) -> None:
    size = settled(overhead, per_sample).size
    assert size == int(SLOWEST * BUDGET_S) or overhead + size * per_sample <= 2.0 * LONG * BUDGET_S
    assert size == LARGEST or overhead + 2.0 * size * per_sample >= 0.5 * LONG * BUDGET_S


def test_pieces_that_took_long_make_others_smaller_for_a_moment_only() -> None:
    pace = settled(1e-5, 1e-9)
    for _ in range(5):
        pace.pieces(1)
        pace.note(10.0 * BUDGET_S, BUDGET_S)
    assert pace.size < LARGEST
    for _ in range(5):
        pace.pieces(1)
        pace.note(0.2 * BUDGET_S, BUDGET_S)
    assert pace.size == LARGEST


def test_a_piece_of_another_kind_says_nothing() -> None:
    pace = settled(1e-5, 1e-9)
    pace.note(10.0 * BUDGET_S, BUDGET_S)
    assert pace.size == LARGEST


def test_no_piece_is_empty() -> None:
    assert Pace().pieces(10**9) == 1
