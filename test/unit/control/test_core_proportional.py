"""Structure (3.2) with its algebraic loop."""

from math import isfinite

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import NO_STATE, Play, usual_plays

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.paper_structure import LARGEST_F_OVER_M, Proportional
from backlash_ros.core.control.protocol import Command, ControlInput
from backlash_ros.core.estimate import Estimate

LARGEST_SHARE = 0.8  # of m that f may have


def estimate_of(play: Play, f_over_m: float) -> Estimate:
    return Estimate(play.m, play.c_r, play.c_l, f_over_m * play.m)


def control(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> Command:
    return Proportional().control(ControlInput(y_m, 0.0, estimate, NO_STATE), inverse)


def tolerance(play: Play, y_m: float, u_d: float) -> float:
    return 10.0 * (play.rounding(u_d) + 1e-12 * abs(y_m))


@given(
    samples=st.lists(
        st.tuples(usual_plays(), st.floats(-0.8, LARGEST_SHARE), st.floats(-100.0, 100.0)),
        min_size=1, max_size=40,
    ),
)
def test_u_d_equals_y_m_plus_f_v_for_any_estimate_and_signal(samples):
    inverse = BacklashInverse()
    for play, share, y_m in samples:
        command = control(y_m, estimate_of(play, share), inverse)
        assert command.f == pytest.approx(share * play.m)
        assert command.u_d == pytest.approx(
            y_m + command.f * command.v, abs=tolerance(play, y_m, command.u_d)
        )
        assert command.v == inverse.v


@given(
    samples=st.lists(
        st.tuples(usual_plays(), st.floats(0.0, LARGEST_SHARE), st.floats(-100.0, 100.0)),
        min_size=1, max_size=40,
    ),
)
def test_v_satisfies_the_printed_inverse_at_the_same_time(samples):
    inverse = BacklashInverse()
    u_d_before, v_before = 0.0, 0.0
    for play, share, y_m in samples:
        command = control(y_m, estimate_of(play, share), inverse)
        slack = tolerance(play, y_m, command.u_d)
        on_right = command.u_d / play.m + play.c_r
        on_left = command.u_d / play.m + play.c_l
        fits_printed = (
            (command.u_d > u_d_before - slack and abs(command.v - on_right) <= slack / play.m)
            or (command.u_d < u_d_before + slack and abs(command.v - on_left) <= slack / play.m)
            or (abs(command.u_d - u_d_before) <= slack and command.v == v_before)
        )
        assert fits_printed
        u_d_before, v_before = command.u_d, command.v


@given(play=usual_plays(), y_m=st.floats(-100.0, 100.0),
       share=st.one_of(st.just(1.0), st.floats(0.99, 1.01), st.floats(0.8, 100.0)))
def test_f_near_or_beyond_m_is_limited(play: Play, y_m: float, share: float) -> None:
    command = control(y_m, estimate_of(play, share), BacklashInverse())
    assert command.f == pytest.approx(LARGEST_SHARE * play.m)
    assert isfinite(command.u_d)
    assert command.u_d == pytest.approx(
        y_m + command.f * command.v, abs=tolerance(play, y_m, command.u_d)
    )
    assert LARGEST_F_OVER_M == LARGEST_SHARE


def test_v_does_not_stay_where_estimates_far_off_have_led_it() -> None:
    inverse = BacklashInverse()
    before, now = Estimate(0.01, 0.0, 0.0, 0.4), Estimate(0.3, 0.0, 0.0, 0.4)
    for y_m in (10.0, -10.0):
        far = control(y_m, before, inverse)
    assert far.v < -4000.0
    command = control(-10.0, now, inverse)
    assert command.u_d == pytest.approx(-10.0 + command.f * command.v)
    assert abs(command.u_d) <= 1.001 * 10.0 / (1.0 - LARGEST_F_OVER_M)
