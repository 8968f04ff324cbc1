"""Which sample a message holds, and which v the plant had: the bookkeeping of the controller."""

from math import inf, isnan, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.loop import command_history
from backlash_ros.core.loop.sample_counter import UNNUMBERED, Arrival, SampleCounter
from backlash_ros.core.parameters import Parameters

PERIOD_S, PERIOD_NS = 0.01, 10_000_000
START_NS = 1_800_000_000_000_000_000

gaps = st.lists(st.integers(0, 40), min_size=1, max_size=60)
delays = st.lists(st.floats(0.0, 0.08), min_size=61, max_size=61)  # of a period


def stamps_of(gaps: list[int], delays: list[float]) -> list[int]:
    samples = [0]
    for gap in gaps:
        samples.append(samples[-1] + 1 + gap)
    return [
        START_NS + int((sample + delay) * PERIOD_NS)
        for sample, delay in zip(samples, delays, strict=False)]


@given(gaps, delays, st.booleans())
def test_time_stamps_tell_every_missing_sample_though_the_numbers_have_no_gap(gaps, delays, known):
    counter = SampleCounter(PERIOD_S)
    arrivals = [
        counter.count(stamp, 1 + i if known else UNNUMBERED)
        for i, stamp in enumerate(stamps_of(gaps, delays))]
    assert [arrival.missing for arrival in arrivals] == [0, *gaps]
    assert [arrival.unsent for arrival in arrivals] == [0, *(gaps if known else [0] * len(gaps))]
    assert counter.index == sum(gaps) + len(gaps)


@given(gaps)
def test_a_gap_in_the_numbers_counts_though_messages_come_in_a_burst(gaps: list[int]) -> None:
    counter = SampleCounter(PERIOD_S)
    sequence, counted = 7, [counter.count(START_NS, 7).missing]
    for gap in gaps:
        sequence += 1 + gap
        counted.append(counter.count(START_NS, sequence).missing)
    assert (counted, counter.index) == ([0, *gaps], sequence - 1)


def over(
    commands: command_history.CommandHistory, intervals: int, end: float, due: float | None = None,
) -> list[float]:
    end_ns, due_ns = (START_NS + int(t * PERIOD_NS) for t in (end, end if due is None else due))
    return commands.over(intervals, end_ns, due_ns)[0]


def test_a_late_command_leaves_the_older_one_in_use_until_it_comes() -> None:
    commands = command_history.CommandHistory(PERIOD_S)
    commands.publish(1.0, START_NS + 1)
    commands.publish(2.0, START_NS + PERIOD_NS + int(1.5 * PERIOD_NS))
    # y(1) was answered one and a half periods later; y(2) and y(3) are lost, y(4) arrives.
    assert (over(commands, 3, 4.0), commands.counts.late) == ([1.0, 2.0, 2.0], 1)


def test_a_command_that_came_while_the_driver_was_held_up_missed_its_sample() -> None:
    commands = command_history.CommandHistory(PERIOD_S)
    commands.publish(1.0, START_NS + 1)
    commands.publish(2.0, START_NS + int(1.2 * PERIOD_NS))
    # y(1) was due at 1.0 and taken at 1.5, before the driver looked at what had come.
    assert over(commands, 1, end=1.5, due=1.0) == [1.0]


@pytest.mark.parametrize(('passed_ns', 'late'), [
    (0, False), (PERIOD_NS // 10, True), (-PERIOD_NS, False), (100 * PERIOD_NS, True),
])
def test_command_that_was_under_way_when_its_interval_ended_came_too_late(passed_ns, late):
    commands = command_history.CommandHistory(PERIOD_S)
    for _ in range(1000):
        commands.note_transit(passed_ns)
    commands.publish(1.0, START_NS)
    commands.publish(2.0, START_NS + PERIOD_NS - PERIOD_NS // 20)
    assert over(commands, 1, 1.0) == ([1.0] if late else [2.0])
    # However long messages seem to be under way, what leaves early in an interval is there in time.
    commands.publish(3.0, START_NS + PERIOD_NS + PERIOD_NS // 2)
    assert over(commands, 1, 2.0) == [3.0]


def test_the_command_next_to_the_one_in_use_may_have_acted_instead() -> None:
    commands = command_history.CommandHistory(PERIOD_S)
    for k, sent in enumerate((0.2, 1.2, 2.9)):
        commands.publish(float(k), START_NS + int(sent * PERIOD_NS))
    ends_ns = START_NS + 3 * PERIOD_NS
    v, instead = commands.over(3, ends_ns, ends_ns)
    assert (v, instead) == ([0.0, 1.0, 2.0], [1.0, 0.0, 1.0])
    # What leaves just after a sample may have come before it by the clock of another machine.
    v, instead = commands.over(1, START_NS + int(2.8 * PERIOD_NS), START_NS + 2.8 * PERIOD_NS)
    assert (v, instead) == ([1.0], [2.0])
    v, instead = commands.over(1, START_NS + 4 * PERIOD_NS, START_NS + 4.0 * PERIOD_NS)
    assert v == [2.0]
    assert isnan(instead[0])


def test_a_report_that_comes_after_its_output_is_not_taken_for_the_next_one() -> None:
    commands = command_history.CommandHistory(PERIOD_S)
    commands.output_ns = START_NS
    assert commands.reported_over(1, START_NS + PERIOD_NS) == []
    commands.report(10.0, START_NS + PERIOD_NS - 1000)
    assert commands.reported_over(1, START_NS + 2 * PERIOD_NS) == []
    assert commands.counts.unreported == 2


def test_the_report_of_an_interval_that_took_longer_holds_for_all_of_it() -> None:
    commands = command_history.CommandHistory(PERIOD_S)
    commands.output_ns = START_NS
    commands.report(10.0, START_NS + 3 * PERIOD_NS - 1000)
    # Two samples were never taken: the driver was held up from the first to the third.
    assert commands.reported_over(3, START_NS + 3 * PERIOD_NS, unsent=2) == [10.0, 10.0, 10.0]
    commands.report(20.0, START_NS + 5 * PERIOD_NS - 1000)
    # One was taken and lost, with its report.
    assert commands.reported_over(2, START_NS + 5 * PERIOD_NS) == []


def uses(pattern: list[bool], use: str = 'auto') -> tuple[list[bool], int]:
    """Of outputs with and without a report: whether it is used, and how many are missed."""
    commands = command_history.CommandHistory(PERIOD_S, use)
    commands.output_ns = START_NS
    used = []
    for k, is_reported in enumerate(pattern, 1):
        if is_reported:
            commands.report(float(k), START_NS + k * PERIOD_NS - 1000)
        used.append(commands.reported_over(1, START_NS + k * PERIOD_NS) == [float(k)])
    return used, commands.counts.unreported


def test_reports_are_used_from_the_first_on_until_they_stop() -> None:
    n = command_history.CONSISTENT
    used, unreported = uses(
        [False] * 3 + [True] * (n + 10) + [False] + [True] * 5 + [False] * 2 * n + [True] * n)
    assert used == [
        *[False] * 3, *[True] * (n + 10), False, *[True] * 5, *[False] * 2 * n,
        *[False] * (n - 1), True]
    # What is missing counts while reports are used, and not from a driver that has none.
    assert unreported == 1 + n - 1


def test_a_driver_that_leaves_reports_out_from_the_beginning_has_to_show_many_in_a_row() -> None:
    n = command_history.CONSISTENT
    used, _ = uses([True, False] * 5 + [True] * n)
    assert used == [True, *[False] * (9 + n - 1), True]


@pytest.mark.parametrize(('lag', 'beyond', 'most'), [
    (0.0, 0.06, inf), (0.7, -3.0, inf), (0.0, 0.0, inf), (0.7, 0.0, inf), (0.3, 0.0, 0.5),
    (0.0, 0.0, -2.0),
])
def test_the_origin_of_reports_is_found_whether_the_motor_lags_or_is_limited(lag, beyond, most):
    origin, position = command_history.ReportOrigin(), 0.0
    for k in range(1000):
        command = sin(0.1 * k)
        position = lag * position + (1.0 - lag) * min(command, most)
        origin.changed_by(round((position + beyond) / 1e-3) * 1e-3, command)
    assert origin.value == pytest.approx(beyond, abs=1e-3)


@given(st.lists(st.booleans(), max_size=100))
def test_reports_are_used_always_or_never_where_that_is_asked_for(pattern: list[bool]) -> None:
    missing = pattern.count(False)
    assert uses(pattern, 'true') == (pattern, missing)
    assert uses(pattern, 'false') == ([False] * len(pattern), 0)


@pytest.mark.parametrize('use', ['true', 'auto', 'false'])
def test_first_command_goes_on_from_a_report_of_its_own_interval(use: str) -> None:
    commands = command_history.CommandHistory(PERIOD_S, use)
    assert isnan(commands.newest_report(START_NS))
    commands.report(7.0, START_NS)
    assert commands.newest_report(START_NS + 1000) == 7.0
    assert isnan(commands.newest_report(START_NS + 5 * PERIOD_NS))


@pytest.mark.parametrize(('changes', 'use'), [
    ({}, 'auto'), ({'estimator.use_applied_control': True}, 'true'),
    ({'estimator.use_applied_control': False}, 'false'),
    # Whether a report stands before or behind that delay only the user knows.
    ({'control.delay_samples': 1}, 'false'),
    ({'control.delay_samples': 1, 'estimator.use_applied_control': 'true'}, 'true'),
    ({'lockstep': True, 'estimator.use_applied_control': True}, 'false'),
])
def test_use_of_reports_follows_the_parameters(changes: dict[str, object], use: str) -> None:
    assert command_history.report_use(Parameters(changes)) == use


def paced_counter(samples: int = 40) -> tuple[SampleCounter, int]:
    """A counter that has seen a sender keep time, and the stamp of its next sample."""
    counter = SampleCounter(PERIOD_S)
    for k in range(samples):
        assert counter.count(START_NS + k * PERIOD_NS, 1 + k).is_sample
    return counter, START_NS + samples * PERIOD_NS


@given(st.lists(st.floats(0.01, 0.6), min_size=1, max_size=30))
def test_repetitions_and_floods_are_no_samples(shares: list[float]) -> None:
    counter, due = paced_counter()
    number = 40
    for k in range(20):
        number += 1
        assert counter.count(due + k * PERIOD_NS, number) == Arrival(is_sample=True)
        for share in sorted(shares):
            number += 1
            assert not counter.count(due + int((k + share) * PERIOD_NS), number).is_sample
    assert counter.index == 59


@given(st.integers(1, 40), st.integers(0, 40), st.integers(0, 40))
def test_a_repetition_that_is_lost_is_no_missing_sample(lost, repeated, before) -> None:
    counter, due = paced_counter()
    assert not counter.count(due - PERIOD_NS // 2, 41).is_sample
    for k in range(before):
        assert counter.count(due + k * PERIOD_NS, 42 + k) == Arrival()
    number = 42 + before + lost + repeated
    there = counter.count(due + (before + lost) * PERIOD_NS, number)
    assert (there.missing, counter.index) == (lost, 40 + before + lost)


@pytest.mark.parametrize('repeated', [False, True])
@given(st.integers(1, 10**6), st.floats(0.0, 1.0))
def test_second_sender_is_refused_while_the_first_one_sends(repeated, first, phase):
    counter, due = paced_counter()
    if repeated:  # a message of the first one, under a number of its own
        assert not counter.count(due - PERIOD_NS // 2, 41).is_sample
    accepted = 0
    for k in range(100):
        arrivals = [
            (due + k * PERIOD_NS, 41 + repeated + k, True),
            (due + int((k + phase) * PERIOD_NS), 10**7 + first + k, False)]
        for stamp, number, own in sorted(arrivals):
            accepted += counter.count(stamp, number).is_sample and not own
    assert (accepted, counter.index) == (0, 139)


@given(st.integers(10, 10**7))
def test_sender_that_restarts_after_a_silence_is_taken_up(silence: int) -> None:
    counter, due = paced_counter(100)
    start = due + silence * PERIOD_NS
    arrivals = [counter.count(start + k * PERIOD_NS, 1 + k) for k in range(20)]
    assert sum(arrival.restarted for arrival in arrivals) == 1
    assert all(arrival.is_sample for arrival in arrivals[5:])


@given(st.integers(-10**9, -6))
def test_clock_that_is_set_back_is_believed_after_some_samples(jump: int) -> None:
    counter = SampleCounter(PERIOD_S)
    for k in range(40):
        counter.count(START_NS * 10 + k * PERIOD_NS)
    start = START_NS * 10 + (40 + jump) * PERIOD_NS
    arrivals = [counter.count(start + k * PERIOD_NS) for k in range(20)]
    assert all(arrival.is_sample for arrival in arrivals[5:])
    assert sum(arrival.restarted for arrival in arrivals) == 1


def slow(share: float, jitter: float = 0.05) -> list[float]:
    rng = np.random.default_rng(3)
    return [k * (1.0 + share) + jitter * float(rng.random()) for k in range(2000)]


def drifting() -> list[float]:
    return np.cumsum(1.05 + 0.05 * np.sin(np.arange(2000) / 200.0)).tolist()


def pausing() -> list[float]:
    return np.cumsum([1.5 if k % 40 == 39 else 1.0 for k in range(2000)]).tolist()


@pytest.mark.parametrize('stamps', [
    *(slow(share) for share in (0.0, 0.005, 0.03, 0.056, 0.09)), slow(-0.05), drifting(), pausing(),
])
@pytest.mark.parametrize('numbered', [True, False])
def test_a_sender_that_is_slow_or_pauses_has_lost_nothing(stamps, numbered):
    counter = SampleCounter(PERIOD_S)
    for k, stamp in enumerate(stamps):
        arrival = counter.count(
            START_NS + round(stamp * PERIOD_S * 1e9), k + 1 if numbered else UNNUMBERED)
        assert arrival == Arrival(is_sample=True)
        # Commands are judged by when the sample was due: that follows the sender.
        assert -0.7 < (counter.due_ns - START_NS) / (PERIOD_S * 1e9) - stamp < 1e-3


@pytest.mark.parametrize(('first', 'second'), [(1, 1), (100, 1), (1, 100), (5, 6)])
@pytest.mark.parametrize('offset', [0.0, 0.4])
@pytest.mark.parametrize('numbered', [True, False])
def test_of_two_senders_one_is_used_from_the_start(first, second, offset, numbered):
    counter, used = SampleCounter(PERIOD_S), []
    for k in range(200):
        for sender, number, late in ((0, first, 0.0), (1, second, offset)):
            stamp = START_NS + round((k + late) * PERIOD_S * 1e9)
            if counter.count(stamp, number + k, numbered).is_sample:
                used.append(sender)
    assert len(used) <= 202
    assert len(set(used[10:])) == 1


@pytest.mark.parametrize(('periods_ago', 'applied'), [
    (0.4, [1.0, 1.0, 2.0]), (1.0, [1.0, 2.0, 2.0]), (5.0, [2.0, 2.0, 2.0]),
])
def test_control_acts_from_its_arrival_though_the_plant_was_held_up(periods_ago, applied):
    now_ns = 100 * PERIOD_NS
    commands = command_history.CommandHistory(PERIOD_S)
    for v, ago in ((1.0, 9.0), (2.0, periods_ago)):
        commands.publish(v, now_ns - int(ago * PERIOD_NS))
    ended_ns = [now_ns - 1.5 * PERIOD_NS, now_ns - 0.5 * PERIOD_NS, inf]
    assert [commands.at(each)[0] for each in ended_ns] == applied


def told(
    index: list[int], outputs: list[float], stamps: list[float], reported: bool,
) -> list[float]:
    """v of the intervals, where the messages of v are numbered from 0; times in sample periods."""
    v = command_history.v_of_intervals(
        np.array(index), (np.array(outputs) * 1e6).astype(np.int64),
        (np.array(stamps) * 1e6).astype(np.int64), np.arange(float(len(stamps))), reported)
    return np.nan_to_num(v, nan=-1.0).tolist()


def test_the_newest_command_acts_that_is_there_when_the_interval_ends() -> None:
    assert told([0, 1, 2], [0.0, 1.0, 2.0], [0.1, 1.1, 1.2], False) == [0.0, 2.0, 2.0]


def test_reports_of_a_driver_that_was_held_up_are_taken_in_their_order() -> None:
    # It wakes at 4 and reports three intervals at once, of which it has sampled the last only.
    late = [0.99, 3.97, 3.98, 3.99, 4.99]
    assert told([0, 1, 4, 5], [0.0, 1.0, 4.0, 5.0], late, True) == [0.0, 1.0, 2.0, 3.0, 4.0, 4.0]
