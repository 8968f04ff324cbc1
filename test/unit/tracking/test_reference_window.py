"""The references that the tracking structure looks at, and what is kept of the past."""

from __future__ import annotations

from collections import deque

from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.control.tracking.reference_window import ReferenceWindow


@given(
    preview=st.integers(0, 5), history=st.integers(0, 7),
    values=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=80),
)
def test_window_and_past_are_the_last_values_in_order(
    preview: int, history: int, values: list[float],
) -> None:
    window = ReferenceWindow(preview, history)
    assert window.empty
    window.fill(7.0)
    known = deque([7.0] * (preview + 1), maxlen=history + preview + 1)
    for value in values:
        known.append(value)
        assert window.append(value).tolist() == list(known)[-preview - 1:]
        assert window.all().tolist() == list(known)
    assert not window.empty
