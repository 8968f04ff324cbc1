"""Backlash inverse, equations (2.2) and (2.3)."""

from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import plays, signals, usual_plays

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.plant.backlash import Backlash


def as_printed(
    u_d: float, u_d_before: float, v_before: float, m: float, c_r: float, c_l: float,
) -> float:
    """The three cases of (2.3), word for word."""
    if u_d == u_d_before:
        return v_before
    if u_d < u_d_before:
        return u_d / m + c_l
    return u_d / m + c_r


@given(samples=st.lists(st.tuples(plays(), st.floats(-100.0, 100.0)), min_size=1, max_size=40))
def test_adaptive_inverse_equals_the_three_printed_cases(samples):
    inverse = BacklashInverse()
    u_d_before, v_before = 0.0, 0.0
    for play, u_d in samples:
        v = inverse.step(u_d, play.m, play.c_r, play.c_l)
        assert v == as_printed(u_d, u_d_before, v_before, play.m, play.c_r, play.c_l)
        u_d_before, v_before = u_d, v


@given(
    play=usual_plays(), band=st.floats(0.1, 10.0), sign=st.sampled_from([1.0, -1.0]),
    noise=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60), slope=st.floats(0.0, 1.0),
)
def test_noise_within_the_direction_band_never_turns_v(play, band, sign, noise, slope):
    inverse = BacklashInverse(direction_band=band)
    v_before = inverse.step(sign * 2.0 * band, play.m, play.c_r, play.c_l)
    for k, share in enumerate(noise):
        u_d = sign * (2.0 * band + slope * k - 0.99 * share * band)
        v = inverse.step(u_d, play.m, play.c_r, play.c_l)
        assert inverse.side == sign
        assert sign * (v - v_before) >= 0.0
        v_before = v


@given(play=usual_plays(), take_up=st.floats(0.1, 10.0), u_d=st.floats(0.5, 50.0),
       signal=signals())
def test_take_up_crosses_the_gap_with_limited_slope_and_then_arrives(play, take_up, u_d, signal):
    inverse = BacklashInverse(take_up=take_up)
    backlash = Backlash(play.m, play.c_r, play.c_l)
    for target in (u_d, -u_d, u_d, *signal):
        held, v_last = backlash.u, inverse.v
        v = inverse.step(target, play.m, play.c_r, play.c_l)
        u = backlash.step(v)
        # What lies beyond the gap is free.
        assert abs(v - v_last) <= take_up + abs(u - held) / play.m + play.rounding(v)
    # The signal stays where it ends while v crosses: taking up must go on by itself.
    for _ in range(ceil(play.gap / take_up) + 2):
        u = backlash.step(inverse.step(target, play.m, play.c_r, play.c_l))
    assert u == pytest.approx(target, abs=play.rounding(u_d + abs(target)))
