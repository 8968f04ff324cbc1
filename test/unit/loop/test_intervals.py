"""Which v acted over each interval, from the stamps of commands and of reports."""

import numpy as np

from backlash_ros.core.loop.command_history import v_of_intervals


def told(
    index: list[int], outputs: list[float], stamps: list[float], reported: bool,
) -> list[float]:
    """v of the intervals, where the messages of v are numbered from 0; times in sample periods."""
    v = v_of_intervals(
        np.array(index), (np.array(outputs) * 1e6).astype(np.int64),
        (np.array(stamps) * 1e6).astype(np.int64), np.arange(float(len(stamps))), reported,
    )
    return np.nan_to_num(v, nan=-1.0).tolist()


def test_the_newest_command_acts_that_is_there_when_the_interval_ends() -> None:
    assert told([0, 1, 2], [0.0, 1.0, 2.0], [0.1, 1.1, 1.2], False) == [0.0, 2.0, 2.0]


def test_reports_of_a_driver_that_was_held_up_are_taken_in_their_order() -> None:
    # It wakes at 4 and reports three intervals at once, of which it has sampled the last only.
    late = [0.99, 3.97, 3.98, 3.99, 4.99]
    assert told([0, 1, 4, 5], [0.0, 1.0, 4.0, 5.0], late, True) == [0.0, 1.0, 2.0, 3.0, 4.0, 4.0]


def test_a_report_alone_holds_for_all_that_was_not_sampled() -> None:
    late = [0.99, 3.99, 4.99]
    assert told([0, 1, 4, 5], [0.0, 1.0, 4.0, 5.0], late, True) == [0.0, 1.0, 1.0, 1.0, 2.0, 2.0]


def test_reports_in_any_other_number_are_taken_by_their_time() -> None:
    late = [0.99, 1.99, 3.99, 4.99]
    assert told([0, 1, 4, 5], [0.0, 1.0, 4.0, 5.0], late, True) == [0.0, 1.0, 1.0, 2.0, 3.0, 3.0]
