"""The commands that end a loop: within the limits, and where they are meant to end."""

from itertools import pairwise
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.control.limits import Limits, at_rest, last_commands
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError

values = st.floats(-1e3, 1e3)


@given(values, st.floats(0.5, 1e3), st.floats(-1e3, 999.0), st.floats(1e-3, 2e3))
def test_ramp_goes_to_the_v_nearest_to_zero_as_fast_as_the_limits_allow(v, move, low, width):
    limits = Limits(low, low + width, move)
    v = min(max(v, low), low + width)
    commands = [v, *last_commands('ramp', at_rest(v), lambda: limits)]
    assert abs(commands[-1]) == min(abs(min(max(0.0, low), low + width)), abs(v))
    for before, after in pairwise(commands):
        assert abs(after - before) <= move * (1.0 + 1e-9)
        assert low <= after <= low + width


@given(values)
def test_hold_sends_nothing_and_zero_one_command(v: float) -> None:
    assert list(last_commands('hold', at_rest(v), lambda: Limits())) == []
    assert list(last_commands('zero', at_rest(v), lambda: Limits())) == [0.0]
    assert list(last_commands('zero', at_rest(v), lambda: Limits(low=2.0))) == [2.0]


@pytest.mark.parametrize('name', ['on_stop', 'on_timeout'])
def test_ramp_without_a_rate_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match=r'needs a finite control\.rate_max'):
        build_controller(Parameters({name: 'ramp'}))
    assert Parameters({})['control.rate_max'] == inf
    build_controller(Parameters({name: 'ramp', 'control.rate_max': 10.0}))
