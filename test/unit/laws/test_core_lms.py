"""Normalised LMS with projection on (m, m c_r, m c_l)."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import KnownInput, Play, strokes, usual_plays

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.law import Interval
from backlash_ros.core.laws.lms import NormalisedLms
from backlash_ros.core.plant.backlash import Backlash, Region

START = Estimate(0.696, 0.5, -0.5, 0.22)
# Bounds that hold every backlash of the strategies and cannot cut a product short.
WIDE = Bounds((0.01, 1e6), (0.0, 1e9), (-1e9, 0.0))
F_BOUNDS = (-0.5, 0.5)
LAG = 20


def lms(step: float = 1.0, bounds: Bounds = WIDE, step_f: float = 0.0,
        initial: Estimate = START) -> NormalisedLms:
    return NormalisedLms(
        initial, bounds, F_BOUNDS, KnownInput(LAG), step, step_f  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class Lesson:
    """A sample that was learned from: what was true of it, and the estimates around it."""

    v: float
    u: float
    region: Region
    old: Estimate
    new: Estimate

    @property
    def e(self) -> float:
        c = self.old.c_r if self.region == Region.RIGHT else self.old.c_l
        return self.u - self.old.m * (self.v - c)


def lessons(
    estimator: NormalisedLms, play: Play, signal: list[float], u_d: float = 0.0,
) -> list[Lesson]:
    """Let the estimator watch a backlash driven by the signal; u is known to it exactly."""
    plant, past, result = Backlash(play.m, play.c_r, play.c_l), [], []
    for v in signal:
        past.append((v, plant.step(v), plant.region))
        old = estimator.estimate
        estimator.update(past[-1][1], Interval(v, 0.0, u_d, 0.0))
        if estimator.estimate is not old:
            result.append(Lesson(*past[-LAG], old, estimator.estimate))
    return result


def products(m: float, c_r: float, c_l: float) -> np.ndarray:
    return np.array([m, m * c_r, m * c_l])


def distance(estimate: Estimate, play: Play, v_max: float) -> float:
    error = products(estimate.m, estimate.c_r, estimate.c_l) - products(play.m, play.c_r, play.c_l)
    return float(np.array([v_max**2, 1.0, 1.0]) @ error**2)


@given(play=usual_plays(), signal=strokes(), step=st.floats(0.05, 1.95))
def test_error_shrinks_by_what_theory_says(play: Play, signal: list[float], step: float) -> None:
    """|theta~|^2 falls by step (2 - step) e^2 / (phi' W phi), and phi' W phi is at most 2."""
    v_max = 0.0
    for lesson in lessons(lms(step), play, signal):
        v_max = max(v_max, abs(lesson.v))
        before, after = (distance(x, play, v_max) for x in (lesson.old, lesson.new))
        fall = 0.5 * step * (2.0 - step) * lesson.e**2
        assert before - after >= fall - 1e-9 * (1.0 + before)


@settings(max_examples=6)
@given(play=usual_plays(), step=st.floats(0.5, 1.5))
def test_known_u_and_a_swing_beyond_the_gap_identify_all_three(play: Play, step: float) -> None:
    # Two amplitudes: one alone shows slope and crossing in nearly the same combination.
    signal = [(30.0 + 30.0 * (k // 50 % 2)) * float(np.sin(0.126 * k)) for k in range(1, 4000)]
    estimator = lms(step)
    lessons(estimator, play, signal)
    e = estimator.estimate
    assert (e.m, e.c_r, e.c_l) == pytest.approx((play.m, play.c_r, play.c_l), rel=1e-2, abs=1e-2)


@given(
    play=usual_plays(), signal=strokes(), step=st.floats(0.1, 1.9), step_f=st.floats(0.0, 1.9),
    u_d=st.floats(-100.0, 100.0),
)
def test_estimates_stay_within_bounds_that_the_truth_violates(play, signal, step, step_f, u_d):
    inside = Estimate(1.0, 1.0, -1.0, 0.22)
    bounds = Bounds((0.75, 1.25), (0.5, 1.5), (-1.5, -0.5))
    for lesson in lessons(lms(step, bounds, step_f, inside), play, signal, u_d):
        e = lesson.new
        assert 0.75 <= e.m <= 1.25
        assert 0.5 <= e.c_r <= 1.5
        assert -1.5 <= e.c_l <= -0.5
        assert F_BOUNDS[0] <= e.f <= F_BOUNDS[1]


def test_a_slope_below_0_is_said_and_not_learned() -> None:
    estimator = lms()
    plant = Backlash(1.3, 3.0, -3.0)
    estimates = []
    for k in range(1, 600):
        v = 20.0 * float(np.sin(0.126 * k))
        estimator.update(-plant.step(v), Interval(v, 0.0, 0.0, 0.0))
        estimates.append(estimator.estimate)
    told = [e for e in estimates if e.status is Status.INCONSISTENT]
    assert estimates.index(told[0]) < 200
    assert {(e.m, e.c_r, e.c_l) for e in told} == {(told[0].m, told[0].c_r, told[0].c_l)}
