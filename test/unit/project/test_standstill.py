"""Tests of what the tests think of the machine."""

import subprocess

import pytest
from standstill import (
    BEGAN,
    STALL_S,
    SUITE_S,
    TICK_S,
    Standstill,
    excuse,
    is_overdue,
    ran_out_of_time,
)


class Clock:
    """A clock that a test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def listened(pauses: list[float]) -> Standstill:
    """One that heard a tick after each of these pauses [s]."""
    clock = Clock()
    standstill = Standstill(clock)
    for pause in pauses:
        clock.now += pause
        standstill.tick()
    return standstill


def test_a_busy_machine_does_not_stand_still() -> None:
    assert listened([0.9 * STALL_S] * 100).share(5.0) == 0.0
    assert listened([TICK_S] * 500 + [STALL_S * 1.5] * 4).reason(5.0) is None


def test_the_share_is_that_of_the_time_looked_back_on() -> None:
    standstill = listened([2.0] + [TICK_S] * 100 + [1.0])
    assert standstill.share(2.0) == pytest.approx(0.5)
    assert standstill.share(3.0) == pytest.approx(2.0 / 3.0)
    assert standstill.share(1e6) == pytest.approx(0.75)
    assert Standstill(Clock()).share(5.0) == 0.0


def test_a_machine_that_is_held_back_is_told_of() -> None:
    reason = listened([0.01, 0.69] * 10).reason(5.0)
    assert reason is not None
    assert '99%' in reason


def test_only_a_suite_that_make_began_long_ago_is_overdue() -> None:
    assert not is_overdue({}, 1e9)
    assert not is_overdue({BEGAN: '1e9'}, 1e9 + SUITE_S - 1.0)
    assert is_overdue({BEGAN: '1e9'}, 1e9 + SUITE_S + 1.0)


@pytest.mark.parametrize(('error', 'of_time'), [
    (TimeoutError('not within 60 s'), True),
    (subprocess.TimeoutExpired('bringup', 60.0), True),
    (pytest.fail.Exception('Timeout (>600.0s) from pytest-timeout.'), True),
    (pytest.fail.Exception('DID NOT RAISE'), False),
    (AssertionError('Timeout'), False),
])
def test_a_wait_in_vain_is_told_from_any_other_failure(error: Exception, of_time: bool) -> None:
    assert ran_out_of_time(error) is of_time


def test_an_excused_failure_is_a_skipped_test_with_its_reason() -> None:
    report = pytest.TestReport('a.py::test', ('a.py', 3, 'test'), {}, 'failed', 'lost', 'call')
    excuse(report, 'stood still')
    assert report.skipped
    assert report.longrepr == ('a.py', 3, 'Skipped: stood still')
