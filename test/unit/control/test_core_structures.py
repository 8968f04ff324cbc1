"""The structures: (3.2) with its algebraic loop, four blocks, the references of tracking."""

from collections import deque
from math import isfinite

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR, Play, plants, usual_plays

from backlash_ros.core import Estimate, Parameters, build_closed_loop
from backlash_ros.core.assembly import build_four_blocks, build_structure
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import LARGEST_F_OVER_M, ControlInput, Proportional
from backlash_ros.core.control.tracking.design import (
    PreviewGains,
    averages,
    power_gain,
    preview_gains,
)
from backlash_ros.core.control.tracking.trajectory import ReferenceWindow
from backlash_ros.core.law import Law
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.numerics import place_poles
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction

LARGEST_SHARE = 0.8  # of m that f may have


def estimate_of(play: Play, f_over_m: float) -> Estimate:
    return Estimate(play.m, play.c_r, play.c_l, f_over_m * play.m)


def control(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> float:
    return Proportional().control(ControlInput(y_m, 0.0, estimate, Law()), inverse)


def tolerance(play: Play, y_m: float, u_d: float) -> float:
    return 10.0 * (play.rounding(u_d) + 1e-12 * abs(y_m))


@given(samples=st.lists(
    st.tuples(usual_plays(), st.floats(-0.8, LARGEST_SHARE), st.floats(-100.0, 100.0)),
    min_size=1, max_size=40,
))
def test_u_d_is_y_m_plus_f_v_and_v_satisfies_the_printed_inverse_at_the_same_time(samples):
    inverse = BacklashInverse()
    u_d_before, v_before = 0.0, 0.0
    for play, share, y_m in samples:
        u_d = control(y_m, estimate_of(play, share), inverse)
        slack = tolerance(play, y_m, u_d)
        assert u_d == pytest.approx(y_m + share * play.m * inverse.v, abs=slack)
        if share >= 0.0:
            turns = (u_d - u_d_before, u_d_before - u_d)
            assert any(turn > -slack and abs(inverse.v - u_d / play.m - c) <= slack / play.m
                       for turn, c in zip(turns, (play.c_r, play.c_l), strict=True)) \
                or (max(turns) <= slack and inverse.v == v_before)
        u_d_before, v_before = u_d, inverse.v


@given(play=usual_plays(), y_m=st.floats(-100.0, 100.0),
       share=st.one_of(st.just(1.0), st.floats(0.99, 1.01), st.floats(0.8, 100.0)))
def test_f_near_or_beyond_m_is_limited(play: Play, y_m: float, share: float) -> None:
    inverse = BacklashInverse()
    u_d = control(y_m, estimate_of(play, share), inverse)
    assert isfinite(u_d)
    assert u_d == pytest.approx(
        y_m + LARGEST_SHARE * play.m * inverse.v, abs=tolerance(play, y_m, u_d))
    assert LARGEST_F_OVER_M == LARGEST_SHARE


def test_v_does_not_stay_where_estimates_far_off_have_led_it() -> None:
    inverse = BacklashInverse()
    before, now = Estimate(0.01, 0.0, 0.0, 0.4), Estimate(0.3, 0.0, 0.0, 0.4)
    for y_m in (10.0, -10.0):
        control(y_m, before, inverse)
    assert inverse.v < -4000.0
    u_d = control(-10.0, now, inverse)
    assert u_d == pytest.approx(-10.0 + LARGEST_SHARE * now.m * inverse.v)
    assert abs(u_d) <= 1.001 * 10.0 / (1.0 - LARGEST_F_OVER_M)


PAPER = TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)


def answer(model: TransferFunction, u: np.ndarray) -> np.ndarray:
    return signal.lfilter(model.numerator, model.denominator, u)


@pytest.mark.parametrize('filter_pole', [0.0, 0.6, 0.9])
def test_loop_without_backlash_answers_as_the_reference_model_says(filter_pole: float) -> None:
    p = Parameters({
        'structure': 'pole_placement', 'pole_placement.filter_pole': filter_pole,
        'estimator.law': 'fixed', 'estimator.initial.m': 1.3, 'estimator.initial.c_r': 0.0,
        'estimator.initial.c_l': 0.0, 'backlash.c_r': 1e-12, 'backlash.c_l': -1e-12,
        'amplitude': 0.2})
    run = build_closed_loop(p).run(300)
    blocks = place_poles(PAPER, build_four_blocks(p).reference.denominator, filter_pole)
    np.testing.assert_allclose(
        run.column('y'), answer(blocks.reference, run.column('y_m')), atol=1e-6)
    ramp = np.arange(400.0)
    late = ramp[-1] - answer(blocks.reference, ramp)[-1]
    assert build_structure(p).delay == round(late) > 0


def test_common_factor_of_numerator_and_denominator_is_refused() -> None:
    model = TransferFunction([1.0, -0.5], [1.0, -1.4, 0.45])
    with pytest.raises(ParameterError, match='common factors'):
        place_poles(model, np.array([1.0, -0.6, 0.09]), 0.3)


def gains_of(
    model: StateModel, weight: float, integral_weight: float = 0.0, window: int = 60,
) -> PreviewGains:
    rho = weight * power_gain(model.transfer_function, np.pi / 10.0)
    return preview_gains(model, rho, integral_weight, window)


def gain_at_rest(model: StateModel, gains: PreviewGains) -> float:
    n = model.order
    closed = np.zeros((n + 1, n + 1))
    closed[:n, :n] = model.a - np.outer(model.b, gains.state)
    closed[:n, n] = -gains.integral * model.b
    closed[n, 0], closed[n, n] = -model.c, 1.0
    driven = np.append(-model.b * gains.preview.sum(), 1.0)
    if not gains.integral:
        closed, driven = closed[:n, :n], driven[:n]
    return float(model.c * np.linalg.solve(np.eye(len(driven)) - closed, driven)[0])


@given(
    model=plants(), weight=st.floats(1e-4, 100.0), window=st.integers(0, 80),
    integral_weight=st.sampled_from([0.0, 1e-4, 1e-2]),
)
def test_the_trajectory_comes_to_rest_at_the_reference(model, weight, window, integral_weight):
    state = StateModel(model)
    gains = gains_of(state, weight, integral_weight, window)
    assert gain_at_rest(state, gains) == pytest.approx(1.0, abs=1e-6)


def taken(window: ReferenceWindow, value: float) -> np.ndarray:
    window.append(value)
    window.settle()
    return window.window


@given(
    preview=st.integers(0, 5), history=st.integers(0, 7),
    values=st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=80),
)
def test_window_and_past_are_the_last_values_in_order(preview, history, values):
    window = ReferenceWindow(preview, history, np.ones(len(averages(preview))))
    assert window.empty
    window.fill(7.0)
    known = deque([7.0] * (preview + 1), maxlen=history + preview + 1)
    for value in values:
        known.append(value)
        assert taken(window, value).tolist() == list(known)[-preview - 1:]
        assert [window.low, window.high] == [min(window.window), max(window.window)]
        assert window.all().tolist() == list(known)
    assert not window.empty


def followed(values: np.ndarray, preview: int = 60) -> np.ndarray:
    window = ReferenceWindow(preview, 10, np.ones(len(averages(preview))))
    window.fill(float(values[0]))
    return np.array([taken(window, value).item(0) for value in values.tolist()])[preview:]


K = np.arange(3000.0)
CLEAN = {
    'slow': np.sin(0.005 * K), 'fast': np.sin(0.2 * K), 'steps': np.sign(np.sin(0.03 * K + 0.01)),
    'moves': np.clip(np.cumsum(0.02 * np.sign(np.sin(0.01 * K)) * (np.sin(0.04 * K) > 0)), -5, 5),
}


@pytest.mark.parametrize('name', CLEAN)
def test_references_without_noise_stay_what_they_are(name: str) -> None:
    assert followed(CLEAN[name]) == pytest.approx(CLEAN[name][:-60], abs=1e-9)


@pytest.mark.parametrize(('name', 'left'), [('slow', 0.35), ('fast', 0.9), ('steps', 0.6)])
def test_noise_of_references_is_averaged_as_far_as_they_are_smooth(name: str, left: float) -> None:
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(K))
    error = followed(CLEAN[name] + noise)[200:] - CLEAN[name][200:-60]
    assert error.std() < left * 0.01


def test_a_step_is_not_smeared_by_averaging_noise() -> None:
    noise = 0.01 * np.random.default_rng(1).standard_normal(400)
    step = np.where(np.arange(400) < 250, 0.0, 1.0)
    assert np.abs(followed(step + noise)[150:] - step[150:-60]).max() < 0.05
