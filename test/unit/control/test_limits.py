"""The last gate: bounds, rate and acceleration of v."""

from itertools import pairwise
from math import ceil, inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.control.limits import LARGEST_SIGNAL, Limits, at_rest, last_commands


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
    """v before and after each target."""
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
