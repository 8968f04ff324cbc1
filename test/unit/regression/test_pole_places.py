"""Where the poles of G may be, told by frequencies, damping and time constants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimation.regression.pole_places import PolePlaces

SPREAD = 0.2
real = st.floats(0.02, 0.999)
complex_pairs = st.builds(
    lambda size, angle: size * np.exp(1j * angle), st.floats(0.3, 0.99), st.floats(0.05, 2.5)
)


def polynomial(poles: list[complex]) -> np.ndarray:
    return np.atleast_1d(np.real(np.poly(poles)))


def places(poles: list[complex]) -> PolePlaces:
    return PolePlaces(np.array(poles, dtype=np.complex128), SPREAD)


@given(st.lists(real, max_size=4), st.lists(complex_pairs, max_size=2), st.floats(-0.9, -0.1))
def test_the_told_place_has_the_told_poles(
    single: list[float], upper: list[complex], negative: float,
) -> None:
    poles = [negative, *single, *upper, *np.conj(upper)]
    told = places(poles)
    a = told.denominator(np.zeros(len(told.told)))
    assert a is not None
    assert a == pytest.approx(polynomial(poles), abs=1e-9)
    # A negative pole has no place of its own.
    assert len(told.told) == len(poles) - 1


@given(real)
def test_one_is_one_deviation_of_a_time_constant(pole: float) -> None:
    a = places([pole]).denominator(np.ones(1))
    assert a is not None
    assert -a[1] == pytest.approx(pole ** np.exp(SPREAD), abs=1e-12)


def test_one_is_one_deviation_of_frequency_and_damping() -> None:
    omega, damping = 0.4, 0.5

    def pair(frequency: float, ratio: float) -> np.ndarray:
        pole = np.exp(frequency * (-ratio + 1j * np.sqrt(1.0 - ratio**2)))
        return polynomial([pole, np.conj(pole)])

    told = places(list(np.roots(pair(omega, damping))))
    faster = told.denominator(np.array([1.0, 0.0]))
    assert faster == pytest.approx(pair(omega * np.exp(SPREAD), damping), abs=1e-9)
    small = 1e-3
    damped = told.denominator(np.array([0.0, small]))
    assert damped == pytest.approx(pair(omega, damping * (1.0 + SPREAD * small)), abs=1e-6)


def test_two_equal_poles_part_either_way() -> None:
    told = places([0.9, 0.9])
    apart, complex_pair = (told.denominator(np.array([0.0, xi])) for xi in (1.0, -1.0))
    assert np.all(np.roots(apart).imag == 0.0)
    assert np.all(np.roots(complex_pair).imag != 0.0)
    # And smoothly: as the slope between them says.
    slope = told.slopes(np.zeros(2))[1]
    assert slope == pytest.approx((apart - complex_pair) / 2.0, rel=0.05)


def test_a_double_pole_that_rounding_has_split_is_a_place() -> None:
    split = complex(0.9, 1e-10)
    told = places([split, split.conjugate()])
    assert np.all(np.isfinite(told.slopes(np.zeros(2))))
    assert told.denominator(np.zeros(2)) == pytest.approx(polynomial([0.9, 0.9]), abs=1e-9)


def test_poles_outside_of_the_unit_circle_are_no_place() -> None:
    pair = 0.9 * np.exp(0.3j)
    assert places([pair, np.conj(pair)]).denominator(np.array([0.0, -50.0])) is None
    assert places([0.9]).denominator(np.array([-100.0])) is None


@given(st.lists(real, min_size=1, max_size=5), st.data())
def test_slopes_are_those_of_small_steps(poles: list[float], data: st.DataObject) -> None:
    told = places(poles)
    count = len(told.told)
    xi = np.array(data.draw(st.lists(st.floats(-1.0, 1.0), min_size=count, max_size=count)))
    step = 1e-3
    here = told.denominator(xi)
    assert here is not None
    for slope, direction in zip(told.slopes(xi), np.eye(count), strict=True):
        there = told.denominator(xi + step * direction)
        assert there is not None
        assert there - here == pytest.approx(step * slope, abs=10.0 * step**2)
