"""Backlash, equation (2.1)."""

from __future__ import annotations

from fractions import Fraction
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import Play, eighths, plays, signals

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.backlash import Backlash, Region


def as_printed(u_before: Fraction, v: Fraction, m: Fraction, c_r: Fraction, c_l: Fraction,
               ) -> tuple[Fraction, Region]:
    """The three cases of (2.1), word for word, in exact arithmetic."""
    v_l = u_before / m + c_l
    v_r = u_before / m + c_r
    if v <= v_l:
        return m * (v - c_l), Region.LEFT
    if v >= v_r:
        return m * (v - c_r), Region.RIGHT
    return u_before, Region.GAP


@given(
    m=eighths(1, 40), c_l=eighths(-80, 40), gap=eighths(1, 80), u=eighths(-400, 400),
    signal=st.lists(eighths(-160, 160), min_size=1, max_size=40),
)
def test_clamp_equals_the_three_printed_cases(
    m: float, c_l: float, gap: float, u: float, signal: list[float],
) -> None:
    backlash = Backlash(m, c_l + gap, c_l, u)
    expected = Fraction(u)
    for v in signal:
        expected, region = as_printed(
            expected, Fraction(v), Fraction(m), Fraction(c_l + gap), Fraction(c_l)
        )
        assert backlash.step(v) == expected
        assert backlash.region == region


@given(play=plays(), u=st.floats(-100.0, 100.0), signal=signals())
def test_hysteresis_never_leaves_its_two_lines(play: Play, u: float, signal: list[float]) -> None:
    backlash = Backlash(play.m, play.c_r, play.c_l, u)
    for v in signal:
        u = backlash.step(v)
        assert play.m * (v - play.c_r) <= u <= play.m * (v - play.c_l)


@given(play=plays(), signal=signals(min_size=2))
def test_u_changes_only_while_engaged_and_rises_on_the_right_line_only(
    play: Play, signal: list[float],
) -> None:
    backlash = Backlash(play.m, play.c_r, play.c_l)
    before = backlash.step(signal[0])
    for v in signal[1:]:
        u = backlash.step(v)
        if u > before:
            assert backlash.region == Region.RIGHT
        elif u < before:
            assert backlash.region == Region.LEFT
        if backlash.region == Region.RIGHT:
            assert u == play.m * (v - play.c_r)
        elif backlash.region == Region.LEFT:
            assert u == play.m * (v - play.c_l)
        else:
            assert u == before
        before = u


@given(
    play=plays(), start=st.floats(-100.0, 100.0),
    ends=st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)), share=st.floats(0.0, 1.0),
)
def test_only_the_turning_points_of_v_matter(
    play: Play, start: float, ends: tuple[float, float], share: float,
) -> None:
    low, high = sorted(ends)
    between = min(max(low + share * (high - low), low), high)
    for first, last in ((low, high), (high, low)):
        direct = Backlash(play.m, play.c_r, play.c_l)
        stepped = Backlash(play.m, play.c_r, play.c_l)
        for v in (start, first, last):
            direct.step(v)
        for v in (start, first, between, last):
            stepped.step(v)
        assert direct.u == stepped.u


def test_crossing_the_gap_takes_its_full_width() -> None:
    backlash = Backlash(1.3, 3.0, -3.0)
    assert backlash.step(10.0) == pytest.approx(1.3 * 7.0)
    assert backlash.step(4.0 + 1e-9) == pytest.approx(1.3 * 7.0, abs=1e-12)
    assert backlash.region == Region.GAP
    assert backlash.step(3.0) == pytest.approx(1.3 * 6.0)
    assert backlash.region == Region.LEFT


@pytest.mark.parametrize(
    ('values', 'name'),
    [
        ((0.0, 3.0, -3.0, 0.0), 'backlash.m'),
        ((-1.0, 3.0, -3.0, 0.0), 'backlash.m'),
        ((nan, 3.0, -3.0, 0.0), 'backlash.m'),
        ((1.0, inf, -3.0, 0.0), 'backlash.c_r'),
        ((1.0, 3.0, -inf, 0.0), 'backlash.c_l'),
        ((1.0, 3.0, nan, 0.0), 'backlash.c_l'),
        ((1.0, -3.0, 3.0, 0.0), 'backlash.c_l'),
        ((1.0, 3.0, 3.0, 0.0), 'backlash.c_l'),
        ((1.0, 3.0, -3.0, nan), 'backlash.initial_u'),
    ],
)
def test_invalid_backlash_is_refused_and_named(
    values: tuple[float, float, float, float], name: str,
) -> None:
    with pytest.raises(ParameterError) as refusal:
        Backlash(*values)
    assert refusal.value.name == name
    assert str(refusal.value).startswith(f'{name}=')
