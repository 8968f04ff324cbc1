"""Where the commands go on after an interruption: what is newer, a command or a report?"""

from hypothesis import given
from hypothesis import strategies as st

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


def test_a_command_that_was_heard_last_is_where_v_goes_on() -> None:
    assert abs(first_command(heard_at=7, reported_at=7) - 4.0) <= MOVE


def test_a_newer_report_says_what_the_driver_made_of_it() -> None:
    assert abs(first_command(heard_at=5, reported_at=7) + 4.0) <= MOVE


class SilentDriver:
    """A loop whose driver was given up when v was 8.5."""

    def __init__(self) -> None:
        self.sent: list[float] = []
        self._k = 0
        self._p = Parameters({
            'estimator.law': 'fixed', 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 100.0 * MOVE,
        })
        self.loop = ControlLoop(
            self._p, self.sent.append, Driver(lambda: self._k * PERIOD_NS), None,
            SampleCounter(0.01, from_zero=False), 8.0,
        )
        self.loop.take_reference(30.0)
        self.answer(8.0)
        self._k += 50
        self.loop.give_up()

    def narrow(self, high: float) -> None:
        self.loop.take_up(self._p.replaced({'control.max': high}))

    def answer(self, reported: float) -> float:
        """The v that answers an output with this report."""
        self._k += 1
        stamp_ns = self._k * PERIOD_NS
        self.loop.take_applied(reported, stamp_ns - 1)
        self.loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, self._k))
        return self.sent[-1]


@given(reported=st.floats(-1e12, 1e12), high=st.sampled_from([3.0, 9.0]))
def test_no_report_leads_v_further_out(reported: float, high: float) -> None:
    driver = SilentDriver()
    before = driver.sent[-1]
    driver.narrow(high)
    assert -10.0 <= driver.answer(reported) <= max(before - MOVE, high)


def test_reports_are_heard_first_where_a_gap_makes_the_loop_begin_again() -> None:
    stamp_ns, back = 0, 40
    loop = ControlLoop(
        Parameters({
            'timeout.plant_output': 0.05, 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 10.0,
        }),
        lambda v: None, Driver(
            lambda: stamp_ns,
            lambda: [(2.5, stamp_ns - 1000)] if stamp_ns == back * PERIOD_NS else [],
        ), None, SampleCounter(0.01), 0.0,
    )
    loop.take_reference(0.0)
    for k in (1, 2, 3, back):
        stamp_ns = k * PERIOD_NS
        assert abs(loop.v) <= 0.1 * k  # the driver tells of another v in the gap alone
        loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))
    assert loop.statistics.interruptions == 1
    assert abs(loop.v - 2.5) <= 0.1 + 1e-9
