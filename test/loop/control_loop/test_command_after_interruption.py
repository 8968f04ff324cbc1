"""Where the commands go on after an interruption: what is newer, a command or a report?"""

import pytest

from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters

PERIOD_NS = 10_000_000
MOVE = 0.5  # at most, from sample to sample


def first_command(heard_at: int, reported_at: int) -> float:
    """v after another controller commanded 4.0, and the driver reported -4.0, at these samples."""
    sent: list[float] = []
    now = [0]
    p = Parameters({'control.min': -10.0, 'control.max': 10.0, 'control.rate_max': 100.0 * MOVE})
    loop = ControlLoop(
        p, sent.append, Driver(lambda: now[0] * PERIOD_NS), None,
        SampleCounter(0.01, from_zero=False), 0.0,
    )

    def answer(k: int) -> None:
        now[0] = k
        stamp_ns = k * PERIOD_NS
        loop.take_reference(0.0)
        loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))

    answer(1)
    loop.stand_down()
    for k in range(2, 8):
        now[0] = k
        if k == heard_at:
            loop.hear_other(4.0)
        if k == reported_at:
            loop.take_applied(-4.0, k * PERIOD_NS - 1)
    loop.resume()
    answer(8)
    return sent[-1]


@pytest.mark.parametrize(('heard_at', 'v'), [(7, 4.0), (5, -4.0)])
def test_v_goes_on_from_the_newest_of_a_command_and_a_report_at_7(heard_at, v):
    assert abs(first_command(heard_at, reported_at=7) - v) <= MOVE


def test_reports_are_heard_first_where_a_gap_makes_the_loop_begin_again() -> None:
    stamp_ns, back = 0, 40
    loop = ControlLoop(
        Parameters({
            'timeout.plant_output': 0.05, 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 10.0,
        }),
        lambda v: None, Driver(lambda: stamp_ns), None, SampleCounter(0.01), 0.0,
    )
    loop.take_reference(0.0)
    for k in (1, 2, 3, back):
        stamp_ns = k * PERIOD_NS
        assert abs(loop.v) <= 0.1 * k  # the driver tells of another v in the gap alone
        if k == back:
            loop.take_applied(2.5, stamp_ns - 1000)
        loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))
    assert loop.statistics.interruptions == 1
    assert abs(loop.v - 2.5) <= 0.1 + 1e-9
