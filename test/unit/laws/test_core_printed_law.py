"""The printed law (3.11) and what follows from it."""

from fractions import Fraction

from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import NO_STATE, KnownInput, eighths

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.paper_structure import Proportional
from backlash_ros.core.control.protocol import Command, ControlInput
from backlash_ros.core.estimate import Bounds, Estimate
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.printed_law import PrintedLaw, printed_c, printed_f, printed_m


def feed(estimator: PrintedLaw, u: float, y_m: float) -> Estimate:
    estimator.update(u, Interval(v=0.0, y_m=y_m, u_d=0.0, f=estimator.estimate.f))
    return estimator.estimate


WIDE = Bounds((1e-9, 1e9), (0.0, 1e9), (-1e9, 0.0))
WIDE_F = (-1e9, 1e9)
START = Estimate(0.696, 0.5, -0.5, 0.22)
SMALL = eighths(-80, 80)


def law(initial: Estimate = START, bounds: Bounds = WIDE,
        f_bounds: tuple[float, float] = WIDE_F) -> PrintedLaw:
    return PrintedLaw(initial, bounds, f_bounds, KnownInput())  # type: ignore[arg-type]


def control(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> Command:
    return Proportional().control(ControlInput(y_m, 0.0, estimate, NO_STATE), inverse)


@given(u=SMALL, y_m=SMALL, m=eighths(1, 80), w=SMALL)
def test_printed_f_reduces_to_the_solution_of_e_equal_0(u, y_m, m, w):
    assume(y_m + m * w != 0.0 and u + m * w != 0.0)
    reduced = Fraction(m) * (Fraction(u) - Fraction(y_m)) / (Fraction(u) + Fraction(m * w))
    assert printed_f(u, y_m, m, w) == float(reduced)


@given(u=SMALL, y_m=SMALL, f=eighths(-80, 80), w=SMALL)
def test_printed_m_reduces_to_the_solution_of_e_equal_0(u, y_m, f, w):
    assume(f != 0.0 and y_m + f * w != 0.0 and u - y_m - f * w != 0.0)
    assert printed_m(u, y_m, f, w) == float(Fraction(u) * Fraction(f) / Fraction(u - y_m - f * w))


@given(u=SMALL, y_m=SMALL, f=eighths(-80, 80), m=eighths(1, 80))
def test_printed_c_reduces_to_the_solution_of_e_equal_0(u, y_m, f, m):
    assume(f != 0.0)
    reduced = (Fraction(u) - Fraction(y_m)) / Fraction(f) - Fraction(u) / Fraction(m)
    assert printed_c(u, y_m, f, m) == float(reduced)


@given(data=st.lists(st.tuples(st.floats(-20.0, 20.0), st.floats(-20.0, 20.0)), max_size=40))
def test_guarded_law_stays_finite_and_within_its_bounds(data: list[tuple[float, float]]) -> None:
    bounds = Bounds()
    estimator = law(bounds=bounds, f_bounds=(-0.5, 0.5))
    for u, y_m in [(0.0, 0.0), *data]:
        e = feed(estimator, u, y_m)
        assert bounds.m[0] <= e.m <= bounds.m[1]
        assert bounds.c_r[0] <= e.c_r <= bounds.c_r[1]
        assert bounds.c_l[0] <= e.c_l <= bounds.c_l[1]
        assert -0.5 <= e.f <= 0.5
    # The paper's first sample, u = y_m = 0, leads to 0/0 in m and c.
    assert estimator.skipped >= 1
