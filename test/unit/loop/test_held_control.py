"""Which v acts over intervals that are looked at later, as by a plant that was held up."""

from math import inf

import pytest

from backlash_ros.core.loop.command_history import HeldControl

PERIOD_NS = 10_000_000


@pytest.mark.parametrize(('periods_ago', 'applied'), [
    (0.4, [1.0, 1.0, 2.0]), (1.0, [1.0, 2.0, 2.0]), (5.0, [2.0, 2.0, 2.0]),
])
def test_control_acts_from_its_arrival_though_the_plant_was_held_up(periods_ago, applied):
    now_ns = 100 * PERIOD_NS
    held = HeldControl()
    for v, ago in ((1.0, 9.0), (2.0, periods_ago)):
        held.take(v, now_ns - int(ago * PERIOD_NS))
    ended_ns = [now_ns - 1.5 * PERIOD_NS, now_ns - 0.5 * PERIOD_NS, inf]
    assert [held.over(each) for each in ended_ns] == applied
    assert held.newest == 2.0
