"""Normalised LMS with projection on (m, m c_r, m c_l)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import KnownInput, Play, signals, usual_plays

from backlash_ros.core.backlash import Backlash
from backlash_ros.core.estimator import Bounds, Estimate, Interval, Status
from backlash_ros.core.lms import NormalisedLms

START = Estimate(0.696, 0.5, -0.5, 0.22)
# Bounds that hold every backlash of the strategies and cannot cut a product short.
WIDE = Bounds((0.01, 1e6), (0.0, 1e9), (-1e9, 0.0))
F_BOUNDS = (-0.5, 0.5)


def lms(step: float, bounds: Bounds = WIDE, step_f: float = 0.0,
        initial: Estimate = START) -> NormalisedLms:
    return NormalisedLms(
        initial, bounds, F_BOUNDS, KnownInput(), step, step_f  # type: ignore[arg-type]
    )


def products(m: float, c_r: float, c_l: float) -> np.ndarray:
    return np.array([m, m * c_r, m * c_l])


def distances(
    play: Play, step: float, signal: list[float],
) -> list[tuple[float, float, float]]:
    """Per learning sample |e| and the squared W-norm of the parameter error before and after.

    W = diag(1/v_max^2, 1, 1) grows old with v_max: both norms use the W of their sample.
    """
    plant, estimator = Backlash(play.m, play.c_r, play.c_l), lms(step)
    truth = products(play.m, play.c_r, play.c_l)
    v_max, u_before, result = 0.0, 0.0, []
    for v in signal:
        u = plant.step(v)
        old = estimator.estimate
        estimator.update(u, Interval(v, 0.0, 0.0, 0.0))
        new = estimator.estimate
        if u != u_before:
            v_max = max(v_max, abs(v))
            e = u - old.m * (v - (old.c_r if u > u_before else old.c_l))
            weights = np.array([v_max**2, 1.0, 1.0])
            before, after = (
                float(weights @ (products(x.m, x.c_r, x.c_l) - truth) ** 2) for x in (old, new)
            )
            result.append((abs(e), before, after))
        u_before = u
    return result


@given(
    play=usual_plays(), signal=signals(min_size=5),
    step=st.floats(0.0, 2.0, exclude_min=True, exclude_max=True),
)
def test_error_never_grows_for_a_step_between_0_and_2(
    play: Play, signal: list[float], step: float,
) -> None:
    for _, before, after in distances(play, step, signal):
        assert after <= before * (1.0 + 1e-9) + 1e-12


@given(play=usual_plays(), signal=signals(min_size=5), step=st.floats(0.05, 1.95))
def test_error_shrinks_by_what_theory_says_where_nothing_is_projected(
    play: Play, signal: list[float], step: float,
) -> None:
    """|theta~|^2 falls by step (2 - step) e^2 / (phi' W phi), and phi' W phi is at most 2."""
    for e, before, after in distances(play, step, signal):
        rounding = 1e-9 * (1.0 + before)
        assert before - after >= 0.5 * step * (2.0 - step) * e**2 - rounding


@given(
    m=st.floats(0.1, 10.0), c_r=st.floats(2.0, 20.0), c_l=st.floats(-20.0, -2.0),
    step=st.floats(-1.5, -0.1), v=st.floats(22.0, 60.0),
)
def test_wrong_sign_drives_the_estimates_away(
    m: float, c_r: float, c_l: float, step: float, v: float,
) -> None:
    truth, start = products(m, c_r, c_l), Estimate(1.01 * m, c_r, c_l, 0.0)
    estimator = lms(step, initial=start)
    estimator.update(m * (v - c_r), Interval(v, 0.0, 0.0, 0.0))
    weights = np.array([v**2, 1.0, 1.0])
    before, after = (
        float(weights @ (products(x.m, x.c_r, x.c_l) - truth) ** 2)
        for x in (start, estimator.estimate)
    )
    assert after > before


@settings(max_examples=20)
@given(play=usual_plays(), step=st.floats(0.5, 1.5))
def test_known_u_and_a_swing_beyond_the_gap_identify_all_three(play: Play, step: float) -> None:
    plant, estimator = Backlash(play.m, play.c_r, play.c_l), lms(step)
    for k in range(1, 4000):
        # Two amplitudes: one alone shows slope and crossing in nearly the same combination.
        v = (30.0 + 30.0 * (k // 50 % 2)) * float(np.sin(0.126 * k))
        estimator.update(plant.step(v), Interval(v, 0.0, 0.0, 0.0))
    e = estimator.estimate
    assert (e.m, e.c_r, e.c_l) == pytest.approx((play.m, play.c_r, play.c_l), rel=1e-2, abs=1e-2)


@given(
    data=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), max_size=40),
    step=st.floats(0.1, 1.9), step_f=st.floats(0.0, 1.9),
)
def test_estimates_stay_within_their_bounds_whatever_the_data(
    data: list[tuple[float, float]], step: float, step_f: float,
) -> None:
    bounds = Bounds((0.5, 2.0), (0.25, 4.0), (-4.0, -0.25))
    estimator = lms(step, bounds, step_f)
    for u, v in data:
        estimator.update(u, Interval(v, 0.0, 0.0, 0.0))
        e = estimator.estimate
        assert 0.5 <= e.m <= 2.0
        assert 0.25 <= e.c_r <= 4.0
        assert -4.0 <= e.c_l <= -0.25
        assert F_BOUNDS[0] <= e.f <= F_BOUNDS[1]


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_only_the_product_of_the_side_in_motion_is_learned(sign: float) -> None:
    estimator = lms(1.0)
    estimator.update(sign * 4.0, Interval(sign * 8.0, 0.0, 0.0, 0.0))
    e = estimator.estimate
    other = e.m * (e.c_l if sign > 0.0 else e.c_r)
    assert other == pytest.approx(START.m * (START.c_l if sign > 0.0 else START.c_r))
    moved = e.m * (e.c_r if sign > 0.0 else e.c_l)
    assert moved != pytest.approx(START.m * (START.c_r if sign > 0.0 else START.c_l))


def test_a_step_of_one_explains_the_sample_at_once() -> None:
    estimator = lms(1.0)
    estimator.update(4.0, Interval(8.0, 0.0, 0.0, 0.0))
    e = estimator.estimate
    assert e.m * (8.0 - e.c_r) == pytest.approx(4.0)


def test_nothing_is_learned_in_the_gap() -> None:
    estimator = lms(1.0)
    estimator.update(6.5, Interval(8.0, 0.0, 0.0, 0.0))
    learned = estimator.estimate
    for v in (7.0, 5.0, 3.0):
        estimator.update(6.5, Interval(v, 0.0, 0.0, 0.0))
    assert estimator.estimate == learned


def test_status_says_whether_anything_was_learned() -> None:
    estimator = lms(1.0)
    assert estimator.estimate.status == Status.ACQUIRING
    estimator.update(6.5, Interval(8.0, 0.0, 0.0, 0.0))
    assert estimator.estimate.status == Status.TRACKING


def test_f_is_kept_without_a_step_and_follows_the_gradient_of_j_with_one() -> None:
    kept, adapted = lms(1.0), lms(1.0, step_f=0.1)
    for estimator in (kept, adapted):
        estimator.update(6.5, Interval(v=2.0, y_m=0.0, u_d=5.5, f=0.22))
    assert kept.estimate.f == START.f
    assert adapted.estimate.f == pytest.approx(START.f + 0.1 * (6.5 - 5.5) * 2.0 / (1.0 + 2.0**2))
