"""Which sample a message holds, and which v the plant had: the bookkeeping of the controller."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.nodes.command_history import CommandHistory
from backlash_ros.nodes.sample_counter import Arrival, SampleCounter

PERIOD_S, PERIOD_NS = 0.01, 10_000_000
START_NS = 1_800_000_000_000_000_000

gaps = st.lists(st.integers(0, 40), min_size=1, max_size=60)
delays = st.lists(st.floats(0.0, 0.08), min_size=61, max_size=61)  # of a period


def stamps_of(gaps: list[int], delays: list[float]) -> list[int]:
    """Time stamps of samples 0, 1 + gaps[0], ... that leave with some delay."""
    samples = [0]
    for gap in gaps:
        samples.append(samples[-1] + 1 + gap)
    return [
        START_NS + int((sample + delay) * PERIOD_NS)
        for sample, delay in zip(samples, delays, strict=False)
    ]


@given(gaps, delays)
def test_time_stamps_alone_tell_every_missing_sample(gaps: list[int], delays: list[float]) -> None:
    counter = SampleCounter(PERIOD_S)
    counted = [counter.count(stamp).missing for stamp in stamps_of(gaps, delays)]
    assert counted == [0, *gaps]
    assert counter.index == sum(gaps) + len(gaps)


@given(gaps, delays)
def test_outputs_never_published_show_in_time_though_the_numbers_have_no_gap(
    gaps: list[int], delays: list[float],
) -> None:
    counter = SampleCounter(PERIOD_S)
    stamps = stamps_of(gaps, delays)
    assert [counter.count(stamp, 1 + i).missing for i, stamp in enumerate(stamps)] == [0, *gaps]


@given(gaps)
def test_a_gap_in_the_numbers_counts_though_messages_come_in_a_burst(gaps: list[int]) -> None:
    counter = SampleCounter(PERIOD_S)
    sequence, counted = 7, [counter.count(START_NS, 7).missing]
    for gap in gaps:
        sequence += 1 + gap
        counted.append(counter.count(START_NS, sequence).missing)
    assert counted == [0, *gaps]
    assert counter.index == sequence - 1


@given(st.lists(st.floats(0.0, 0.8), min_size=2, max_size=200))
def test_jitter_below_a_period_is_no_loss(delays: list[float]) -> None:
    counter = SampleCounter(PERIOD_S)
    stamps = [START_NS + int((k + delay) * PERIOD_NS) for k, delay in enumerate(delays)]
    assert sum(counter.count(stamp).missing for stamp in stamps) == 0


@given(st.floats(0.995, 1.005))
def test_a_sender_with_a_slightly_wrong_clock_loses_nothing(ratio: float) -> None:
    counter = SampleCounter(PERIOD_S)
    stamps = [START_NS + int(k * PERIOD_NS * ratio) for k in range(1000)]
    assert sum(counter.count(stamp, 1 + k).missing for k, stamp in enumerate(stamps)) == 0


def test_a_sender_that_was_started_anew_is_counted_by_time() -> None:
    counter = SampleCounter(PERIOD_S)
    counter.count(START_NS, 500)
    assert counter.count(START_NS + 5 * PERIOD_NS, 1) == Arrival(True, 4, anew=True)


def test_a_command_in_time_needs_no_correction() -> None:
    commands = CommandHistory(PERIOD_S)
    commands.publish(1.0, START_NS + 1)
    assert commands.over(3, START_NS + 3 * PERIOD_NS) == []
    assert commands.late == 0


def test_a_late_command_leaves_the_older_one_in_use_until_it_comes() -> None:
    commands = CommandHistory(PERIOD_S)
    commands.publish(1.0, START_NS + 1)
    commands.publish(2.0, START_NS + PERIOD_NS + int(1.5 * PERIOD_NS))
    # y(1) was answered one and a half periods later; y(2) and y(3) are lost, y(4) arrives.
    assert commands.over(3, START_NS + 4 * PERIOD_NS) == [1.0, 2.0, 2.0]
    assert commands.late == 1


def reported(end: int, *reports: tuple[float, float]) -> list[list[float]]:
    """What reports (sample, v) tell of outputs 1 .. end, each taken as far as it has come."""
    commands = CommandHistory(PERIOD_S)
    commands.begin(START_NS)
    answers = []
    for k in range(1, end + 1):
        for sample, v in reports:
            if k - 1 < sample <= k:
                commands.report(v, START_NS + int(sample * PERIOD_NS) - 1000)
        answers.append(commands.reported_over(1, START_NS + k * PERIOD_NS))
    return answers


def test_a_reported_control_belongs_to_the_output_after_it() -> None:
    assert reported(3, (1, 10.0), (2, 20.0), (3, 30.0)) == [[10.0], [20.0], [30.0]]


def test_an_interval_without_a_report_takes_none_from_its_neighbours() -> None:
    assert reported(3, (1, 10.0), (3, 30.0)) == [[10.0], [], [30.0]]


def test_a_report_that_comes_after_its_output_is_not_taken_for_the_next_one() -> None:
    commands = CommandHistory(PERIOD_S)
    commands.begin(START_NS)
    assert commands.reported_over(1, START_NS + PERIOD_NS) == []
    commands.report(10.0, START_NS + PERIOD_NS - 1000)
    assert commands.reported_over(1, START_NS + 2 * PERIOD_NS) == []
    assert commands.unreported == 2


def test_reports_over_lost_outputs_are_used_one_by_one() -> None:
    commands = CommandHistory(PERIOD_S)
    commands.begin(START_NS)
    for k in (1, 2, 3):
        commands.report(10.0 * k, START_NS + k * PERIOD_NS - 1000)
    assert commands.reported_over(3, START_NS + 3 * PERIOD_NS) == [10.0, 20.0, 30.0]
