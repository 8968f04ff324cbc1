"""Backlash, equation (2.1)."""

from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st
from strategies import eighths

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
def test_clamp_equals_the_three_printed_cases(m, c_l, gap, u, signal):
    backlash = Backlash(m, c_l + gap, c_l, u)
    expected = Fraction(u)
    for v in signal:
        expected, region = as_printed(
            expected, Fraction(v), Fraction(m), Fraction(c_l + gap), Fraction(c_l)
        )
        assert backlash.step(v) == expected
        assert backlash.region == region
