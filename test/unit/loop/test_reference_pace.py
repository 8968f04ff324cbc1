"""How often y_m leaves, and for which sample, whatever becomes of plant_output."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.loop.reference_pace import ReferencePace
from backlash_ros.core.loop.sample_counter import SampleCounter

PERIOD_S = 0.005
STEP_S = PERIOD_S / 50.0  # by which the tests let time go on
S_TO_NS = 1e9
ROUNDING_S = 1e-9

arrival_gaps = st.lists(st.floats(0.05, 6.0), min_size=20, max_size=120)  # periods


def messages_of(
    arrivals_s: list[float], end_s: float, sleeps: bool = True,
) -> list[tuple[float, int]]:
    """When y_m left for which sample, with outputs that arrive at these times [s].

    sleeps: whether the node looks for outputs only when it has something to do, as it really does.
    """
    pace = ReferencePace(PERIOD_S, waits=True, now_s=0.0)
    counter = SampleCounter(PERIOD_S)
    waiting, sent = list(arrivals_s), []
    now = 0.0
    while now < end_s:
        if not sleeps or pace.listens(now):
            heard = [at for at in waiting if at <= now]
            waiting = waiting[len(heard):]
            for at in heard:
                if counter.count(int((1.0 + at) * S_TO_NS)).is_sample:
                    pace.hear(counter.index, at)
        sample = pace.sample_to_send(now)
        if sample is not None:
            sent.append((now, sample))
        now += STEP_S
    return sent


def times(count: int, period_s: float = PERIOD_S) -> list[float]:
    return [0.5 * PERIOD_S + k * period_s for k in range(count)]


def check_rate(sent: list[tuple[float, int]], end_s: float) -> None:
    gaps = [later - earlier for (earlier, _), (later, _) in pairwise(sent)]
    assert min(gaps) >= 0.5 * PERIOD_S - ROUNDING_S
    assert len(sent) <= end_s / PERIOD_S + 2


def test_reference_of_the_next_sample_leaves_half_a_period_after_each_output() -> None:
    arrivals = times(100)
    sent = messages_of(arrivals, 100 * PERIOD_S)[2:]
    for at, sample in sent:
        # y(sample - 1) came half a period before.
        assert at - arrivals[sample - 1] == pytest.approx(0.5 * PERIOD_S, abs=2 * STEP_S)
    assert [sample for _, sample in sent] == list(range(sent[0][1], sent[0][1] + len(sent)))


@given(arrival_gaps, st.booleans())
def test_there_is_never_more_than_a_message_per_period_nor_two_close_together(gaps, sleeps):
    arrivals, at = [], 0.0
    for gap in gaps:
        at += gap * PERIOD_S
        arrivals.append(at)
    end_s = at + 10 * PERIOD_S
    sent = messages_of(arrivals, end_s, sleeps)
    check_rate(sent, end_s)
    samples = [sample for _, sample in sent]
    begun = [sample for sample in samples if sample > 0]
    assert begun == sorted(set(begun))


def test_a_node_that_waits_for_nobody_goes_on_by_its_own_clock() -> None:
    pace = ReferencePace(PERIOD_S, waits=False, now_s=0.0)
    sent = [pace.sample_to_send(k * STEP_S) for k in range(1000)]
    assert [sample for sample in sent if sample is not None] == list(range(20))
    pace.hear(7, 1000 * STEP_S)
    assert pace.sample_to_send(1001 * STEP_S) == 20
    pace.hear(8, 1050 * STEP_S)
    assert pace.sample_to_send(1060 * STEP_S) is None
    assert pace.sample_to_send(1076 * STEP_S) == 21


def test_signal_goes_on_by_the_own_clock_once_outputs_are_no_longer_waited_for() -> None:
    pace = ReferencePace(PERIOD_S, waits=True, now_s=0.0)
    assert [pace.sample_to_send(k * PERIOD_S) for k in range(3)] == [0, 0, 0]
    assert pace.waits
    pace.waits = False
    sent = [pace.sample_to_send(k * PERIOD_S) for k in range(3, 6)]
    assert sent == [0, 1, 2]
