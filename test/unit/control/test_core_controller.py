"""One step of the controller: who sees what, in which order, and within which limits."""

from dataclasses import replace
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import signals

from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.control.structure import Proportional
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.parameters import Bounds

PAPER = Estimate(1.3, 3.0, -3.0, 0.22)


class Notebook(Law):
    """An estimator that writes down what it is told; each update adds 0.1 to c_r."""

    def __init__(self, estimate: Estimate = PAPER, learns: float = 0.0) -> None:
        self.estimate = estimate
        self.learns = learns
        self.updates: list[tuple[float | None, Interval]] = []

    def update(self, y: float | None, interval: Interval) -> None:
        self.updates.append((y, interval))
        self.estimate = replace(self.estimate, c_r=self.estimate.c_r + self.learns)


def controller(
    estimator: Notebook, limits: Limits | None = None, inverse: BacklashInverse | None = None,
) -> AdaptiveController:
    return AdaptiveController(
        estimator, Proportional(), inverse or BacklashInverse(), limits or Limits())


def test_output_is_paired_with_what_was_applied_before_it() -> None:
    estimator = Notebook()
    c = controller(estimator)
    first = c.step(0.0, 1.0)
    second = c.step(0.1, 2.0)
    c.step(0.2, 3.0)
    c.refine()
    assert estimator.updates == [
        (0.1, Interval(first.v, 1.0, first.u_d)),
        (0.2, Interval(second.v, 2.0, second.u_d))]


def test_a_command_uses_what_its_output_has_taught() -> None:
    estimator = Notebook(replace(PAPER, f=0.0), learns=0.1)
    c = AdaptiveController(estimator, Proportional(), BacklashInverse(), Limits())
    c.step(0.0, 1.0)
    step = c.step(0.1, 2.0)
    assert step.estimate.c_r == pytest.approx(3.1)
    assert step.v == pytest.approx(2.0 / 1.3 + 3.1)


@given(losses=st.lists(st.integers(0, 5), min_size=2, max_size=20))
def test_lost_samples_are_stepped_over_with_the_held_v(losses: list[int]) -> None:
    estimator = Notebook()
    c = controller(estimator)
    expected: list[tuple[float | None, float]] = []
    v = None
    for k, lost in enumerate(losses):
        if v is not None:
            expected += [(None, v)] * lost + [(float(k), v)]
        v = c.step(float(k), float(k), lost).v
    c.refine()
    assert [(y, interval.v) for y, interval in estimator.updates] == expected
    assert c.lost_samples == sum(losses[1:])


def test_control_that_was_really_applied_replaces_the_own_command() -> None:
    estimator = Notebook()
    c = controller(estimator)
    c.step(0.0, 1.0)
    c.step(0.1, 2.0, lost=1, applied=(0.75, 0.75))
    c.refine()
    assert [interval.v for _, interval in estimator.updates] == [0.75, 0.75]


@given(signal=signals(), low=st.floats(-20.0, -1.0), high=st.floats(1.0, 20.0),
       move=st.one_of(st.just(inf), st.floats(0.1, 10.0)))
def test_limits_hold_and_the_estimator_is_told_the_limited_v(signal, low, high, move):
    estimator = Notebook()
    c = controller(estimator, Limits(low, high, move))
    published = [0.0]
    for y_m in signal:
        v = c.step(0.0, y_m).v
        assert low <= v <= high
        assert abs(v - published[-1]) <= move + 1e-9
        published.append(v)
    c.refine()
    assert [interval.v for _, interval in estimator.updates] == published[1:-1]


@pytest.mark.parametrize('f', [0.0, 0.22])
def test_new_estimates_move_v_no_faster_than_the_gap_is_crossed(f: float) -> None:
    estimator = Notebook(replace(PAPER, f=f, c_r=1.0))
    c = controller(estimator, inverse=BacklashInverse(take_up=0.1))
    y_m = 0.0
    for _ in range(60):
        y_m += 0.02
        c.step(0.0, y_m)
    for changed in (PAPER, replace(PAPER, m=0.7)):
        estimator.estimate = replace(changed, f=f)
        moves = []
        for _ in range(80):
            before, y_m = c.inverse.v, y_m + 1e-6
            moves.append(abs(c.step(0.0, y_m).v - before))
        assert max(moves) <= 0.1 + 1e-3, 'the line is reached, and what y_m has moved meanwhile'
        assert c.inverse.v == pytest.approx(3.0 + (y_m + 3.0 * f) / (changed.m - f))
    c.compensating = False
    before = c.inverse.v
    assert abs(c.step(0.0, y_m + 1e-6).v - before) <= 0.1 * (1.0 + 1e-9)


@pytest.mark.parametrize('bad', [nan, inf, -inf])
@pytest.mark.parametrize('name', ['y', 'y_m', 'applied'])
def test_input_that_is_not_finite_is_refused_and_changes_nothing(name: str, bad: float) -> None:
    estimator, untouched = Notebook(), Notebook()
    disturbed, reference = controller(estimator), controller(untouched)
    for c in (disturbed, reference):
        c.step(0.0, 1.0)
    values: dict[str, float] = {'y': 0.1, 'y_m': 2.0, 'applied': 1.0, name: bad}
    with pytest.raises(ValueError, match='must be finite'):
        disturbed.step(values['y'], values['y_m'], applied=(values['applied'],))
    assert estimator.updates == []
    assert disturbed.step(0.2, 3.0) == reference.step(0.2, 3.0)


@pytest.mark.parametrize('bounds', [
    Bounds((0.5, 2.0), (0.0, 4.0), (-4.0, -1.0)), Bounds((0.5, 2.0), (-3.0, 4.0), (-4.0, 2.0)),
])
@given(values=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_projection_is_the_nearest_point_within_the_bounds_with_crossings_in_order(bounds, values):
    m, c_r, c_l = projected = bounds.project(*values)
    assert c_l <= c_r
    for value, found, (low, high) in zip(
        values, projected, (bounds.m, bounds.c_r, bounds.c_l), strict=True
    ):
        assert low <= found <= high
        assert found == min(max(value, low), high) or c_r == c_l  # else in the wrong order
    assert bounds.project(m, c_r, c_l) == projected
