"""Records and jobs, computed at once."""

import operator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.jobs.executor import (
    BLOCK,
    Failure,
    InlineExecutor,
    Record,
    Samples,
)


def everything(samples: Samples, *more: object) -> tuple[object, ...]:
    return samples.first, samples.columns.tolist(), *more


@given(
    blocks=st.lists(st.integers(0, 700), max_size=12), capacity=st.integers(1, 1500),
    held_back=st.integers(0, 50),
)
def test_record_holds_the_newest_samples_with_their_numbers(blocks, capacity, held_back):
    record = Record(2, capacity)
    rows = np.arange(2.0 * sum(blocks)).reshape(-1, 2)
    for part in np.split(rows, np.cumsum(blocks)[:-1]) if blocks else []:
        record.extend(part.tobytes())
    end = max(len(rows) - held_back, 0)
    first, columns = record.until(end)
    # Of what is older than the newest `capacity` of all, some may be gone.
    assert max(end - capacity, 0) <= first <= max(end - capacity, len(rows) - capacity, 0)
    np.testing.assert_array_equal(columns.T, rows[first:end])


def test_samples_cannot_be_changed_by_a_job() -> None:
    channel = InlineExecutor().open(1, 10)
    channel.append(1.0)
    channel.submit(overwrite)
    failure = channel.poll()
    assert isinstance(failure, Failure)
    assert failure.kind == 'ValueError'
    channel.submit(everything)
    assert channel.poll() == (0, [[1.0]])


def overwrite(samples: Samples) -> None:
    samples.columns[:] = 0.0


@pytest.mark.parametrize('count', [0, 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_a_job_gets_all_samples_up_to_its_submission(count: int) -> None:
    channel = InlineExecutor().open(2, 10_000)
    for k in range(count):
        channel.append(k, -k)
        channel.tend()
    assert channel.submit(everything, 'x')
    channel.append(7.0, 7.0)
    assert channel.poll() == (0, [[*range(count)], [-k for k in range(count)]], 'x')


def test_one_job_at_a_time_whose_result_is_told_once() -> None:
    channel = InlineExecutor().open()
    assert channel.submit(operator.add, 2, 3)
    assert not channel.submit(operator.add, 4, 5)
    assert channel.busy
    assert channel.poll() == 5
    assert not channel.busy
    assert channel.poll() is None
