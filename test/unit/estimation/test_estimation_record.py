"""The samples that are kept."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimation.constants import GROWTH, LONGEST, SEARCH_GROWTH
from backlash_ros.core.estimation.fit.record import Record
from backlash_ros.core.estimation.moving_horizon.learning import next_length

CAPACITY = 7
steps = st.lists(st.one_of(
    st.tuples(st.just('append'), st.floats(-9.0, 9.0)),
    st.tuples(st.just('forget'), st.floats(0.0, 1.0)),
    st.tuples(st.just('lose'), st.floats(0.0, 1.0)),
), max_size=80)


@given(steps)
def test_record_is_what_was_appended_and_not_yet_let_go(done: list[tuple[str, float]]) -> None:
    record = Record(CAPACITY)
    kept: list[list[float]] = []
    first = number = 0
    for what, value in done:
        if what == 'append':
            if len(kept) == CAPACITY:
                record.forget_before(first + 3)
                kept, first = kept[3:], first + 3
            record.append(value, number)
            kept.append([value, number])
            number += 1
        elif what == 'forget':
            gone = int(value * len(kept))
            record.forget_before(first + gone)
            kept, first = kept[gone:], first + gone
        elif kept:
            lost = int(value * (len(kept) - 1))
            record.lose(np.array([first + lost]))
            kept[lost][1] = np.nan
        assert (len(record), record.first, record.end) == (len(kept), first, number)
    for begin in range(first, number):
        v, y = record.since(begin)
        assert v.tolist() == [pair[0] for pair in kept[begin - first:]]
        assert np.array_equal(y, [pair[1] for pair in kept[begin - first:]], equal_nan=True)


def test_samples_that_were_taken_out_stay_what_they_are() -> None:
    record = Record(CAPACITY)
    record.append(1.0, 2.0)
    v, y = record.since(0)
    record.lose(np.array([0]))
    record.append(3.0, 4.0)
    assert (v.tolist(), y.tolist()) == ([1.0], [2.0])


def test_y_in_doubt_counts_as_lost_until_it_is_restored() -> None:
    record = Record(CAPACITY)
    for k in range(4):
        record.append(float(k), nan if k in (1, 2) else float(k))
    record.doubt(1, 11.0)
    record.doubt(2, 12.0)
    assert np.array_equal(record.doubted(0, 4), [nan, 11.0, 12.0, nan], equal_nan=True)
    record.restore([0, 2])
    assert np.array_equal(record.since(0)[1], [0.0, nan, 12.0, 3.0], equal_nan=True)
    record.forget_before(2)
    assert np.isnan(record.doubted(1, 3)).all()


def test_more_than_it_holds_is_refused() -> None:
    record = Record(2)
    for k in range(4):  # there is room for as many again, before the samples are moved
        record.append(float(k), 0.0)
    with pytest.raises(OverflowError, match='let old ones go'):
        record.append(4.0, 0.0)


def test_a_reading_in_doubt_that_a_fit_has_gone_on_without_stays_lost() -> None:
    record = Record(10)
    for k in range(4):
        record.append(0.0, nan, nan)
        record.doubt(k, 10.0 + k)
    record.decide_doubts(2)
    record.restore([0, 1, 2, 3])
    assert np.array_equal(record.since(0)[1], [nan, nan, 12.0, 13.0], equal_nan=True)


@given(st.integers(20, LONGEST), st.sampled_from([SEARCH_GROWTH, GROWTH]))
def test_equal_steps_of_growth_lead_to_the_longest_record(length: int, growth: float) -> None:
    refits = [float(length)]
    while refits[-1] < LONGEST - 1e-6:
        refits.append(next_length(round(refits[-1]), growth))
        assert refits[-1] <= refits[-2] * growth**1.6
    assert refits[-1] == pytest.approx(LONGEST)
