"""From u_d to the command: the inverse (2.2), (2.3), the limits of v, the last commands."""

from itertools import pairwise
from math import ceil, inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import plays, signals, usual_plays

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import LARGEST_SIGNAL, Limits, at_rest, last_commands
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.backlash import Backlash


def as_printed(
    u_d: float, u_d_before: float, v_before: float, m: float, c_r: float, c_l: float,
) -> float:
    if u_d == u_d_before:
        return v_before
    return u_d / m + (c_l if u_d < u_d_before else c_r)


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


@given(play=usual_plays(), take_up=st.floats(0.1, 10.0), u_d=st.floats(0.5, 50.0), signal=signals())
def test_take_up_crosses_the_gap_with_limited_slope_and_then_arrives(play, take_up, u_d, signal):
    inverse = BacklashInverse(take_up=take_up)
    backlash = Backlash(play.m, play.c_r, play.c_l)
    for target in (u_d, -u_d, u_d, *signal):
        held, v_last = backlash.u, inverse.v
        v = inverse.step(target, play.m, play.c_r, play.c_l)
        u = backlash.step(v)
        assert abs(v - v_last) <= take_up + abs(u - held) / play.m + play.rounding(v)
    # The signal stays where it ends while v crosses: taking up must go on by itself.
    for _ in range(ceil(play.gap / take_up) + 2):
        u = backlash.step(inverse.step(target, play.m, play.c_r, play.c_l))
    assert u == pytest.approx(target, abs=play.rounding(u_d + abs(target)))


@given(st.one_of(st.floats(), st.just(1e300)), st.floats(-10.0, 10.0), st.floats(-20.0, 5.0),
       st.floats(0.1, 30.0), st.one_of(st.just(inf), st.floats(0.1, 10.0)))
def test_whatever_is_asked_what_is_sent_is_a_number_that_keeps_the_limits(
    asked: float, v: float, low: float, width: float, move: float,
) -> None:
    limits = Limits(low, low + width, move)
    sent = limits.apply(asked, at_rest(v)).v
    assert abs(sent - v) <= move * (1.0 + 1e-12)
    outside, outside_before = (max(low - x, x - low - width, 0.0) for x in (sent, v))
    assert outside <= max(outside_before - move, 0.0) + 1e-12
    assert abs(Limits(move=move).apply(asked, at_rest(v)).v) <= LARGEST_SIGNAL


@pytest.mark.parametrize(('told', 'known', 'begins'), [
    (4.0, None, 4.0), (9.0, None, 5.0), (-9.0, None, -5.0), (9.0, 3.0, 5.0),
    (9.0, 9.0, 9.0), (7.0, 9.0, 7.0), (20.0, 9.0, 9.0), (-9.0, 9.0, -5.0), (-9.0, -7.0, -7.0),
])
def test_what_others_tell_of_v_leads_it_no_further_out(told, known, begins):
    assert Limits(-5.0, 5.0, 0.1).go_on_from(told, known) == begins


def sent(limits: Limits, targets: list[float], v: float = 0.0) -> list[float]:
    motion, commands = at_rest(v), [v]
    for target in targets:
        motion = limits.apply(target, motion)
        commands.append(motion.v)
    return commands


def accelerations(v: list[float]) -> list[float]:
    return np.abs(np.diff(v, 2, prepend=[v[0]])).tolist()


@given(targets=st.lists(st.one_of(st.floats(-20.0, 20.0), st.just(1e13)), min_size=1, max_size=80),
       width=st.floats(0.1, 30.0), move=st.one_of(st.just(inf), st.floats(0.01, 5.0)),
       acceleration=st.floats(0.01, 5.0))
def test_no_target_makes_v_faster_or_hastier_or_leave_its_bounds(
    targets: list[float], width: float, move: float, acceleration: float,
) -> None:
    v = sent(Limits(-0.5 * width, 0.5 * width, move, acceleration), targets)
    assert max(map(abs, v)) <= 0.5 * width + 1e-9
    assert max(abs(b - a) for a, b in pairwise(v)) <= move + 1e-9
    assert max(accelerations(v)) <= acceleration + 1e-9


@given(target=st.floats(-50.0, 50.0), move=st.one_of(st.just(inf), st.floats(0.05, 5.0)),
       acceleration=st.floats(0.01, 5.0))
def test_v_comes_to_rest_at_a_target_without_overshoot_and_as_soon_as_it_is_said_to(
    target: float, move: float, acceleration: float,
) -> None:
    limits = Limits(move=move, acceleration=acceleration)
    needed = ceil(limits.samples_across(abs(target))) + 2
    v = sent(limits, [target] * needed)
    assert v[-1] == target
    assert max(map(abs, v)) <= abs(target) * (1.0 + 1e-12)
    assert max(accelerations(v)) <= acceleration * (1.0 + 1e-9) + 1e-12


@pytest.mark.parametrize('action', ['hold', 'zero', 'ramp'])
def test_the_last_commands_brake(action: str) -> None:
    limits = Limits(move=2.0, acceleration=0.3)
    motion = at_rest(0.0)
    v = [0.0]
    for _ in range(10):
        motion = limits.apply(100.0, motion)
        v.append(motion.v)
    v += last_commands(action, motion, lambda: limits)
    assert max(accelerations([*v, v[-1]])) <= 0.3 + 1e-9
    assert v[-1] == (0.0 if action != 'hold' else max(v))


values = st.floats(-1e3, 1e3)


@given(values, st.floats(0.5, 1e3), st.floats(-1e3, 999.0), st.floats(1e-3, 2e3))
def test_ramp_goes_to_the_v_nearest_to_zero_as_fast_as_the_limits_allow(v, move, low, width):
    limits = Limits(low, low + width, move)
    v = min(max(v, low), low + width)
    commands = [v, *last_commands('ramp', at_rest(v), lambda: limits)]
    assert abs(commands[-1]) == min(abs(min(max(0.0, low), low + width)), abs(v))
    for before, after in pairwise(commands):
        assert abs(after - before) <= move * (1.0 + 1e-9)
        assert low <= after <= low + width


@given(values)
def test_hold_sends_nothing_and_zero_one_command(v: float) -> None:
    assert list(last_commands('hold', at_rest(v), lambda: Limits())) == []
    assert list(last_commands('zero', at_rest(v), lambda: Limits())) == [0.0]
    assert list(last_commands('zero', at_rest(v), lambda: Limits(low=2.0))) == [2.0]


@pytest.mark.parametrize('name', ['on_stop', 'on_timeout'])
def test_ramp_without_a_rate_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match=r'needs a finite control\.rate_max'):
        build_controller(Parameters({name: 'ramp'}))
    assert Parameters({})['control.rate_max'] == inf
    build_controller(Parameters({name: 'ramp', 'control.rate_max': 10.0}))
