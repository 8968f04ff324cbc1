"""The verdict: three answers, each with its reason and the cure, from numbers alone."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from test_not_play import GAP, NOISE, V, behind, dead_zone, observed, play

from backlash_ros.core.judgement.verdict import Findings, Verdict, judge

GOOD = observed(V, behind(play(V, GAP), 'lag'))
WANDER = 0.0155 * lfilter([1.0], [1.0, -0.95], np.random.default_rng(8).standard_normal(len(V)))
SAW = 0.02 * np.abs(np.arange(3000) % 400 - 200.0)
FOUND = Findings(
    GOOD, gap_std=0.01, apart=0.0, c_r_std=0.01, gain=0.8, gain_std=0.01, response_std=0.02,
    evidence=1e3, rivals=(), open_delay=0, by_delay=0.0)


def verdict(**changed: Any) -> Verdict:
    return judge(FOUND._replace(**changed))


def test_a_gap_is_known_though_gain_and_middle_are_not() -> None:
    found = verdict(gain_std=40.0, response_std=0.3)
    assert (found.backlash.known, found.gain.known, found.model.known) == (True, False, True)
    first, second = found.lines
    assert first.startswith('the gap is 0.6 ± 0.01; the gain of G at rest is not known at all')
    assert second == (
        'G is known to 30 %: good enough to start the controller with plant.uncertainty as in '
        'identified.yaml, which learns the rest')
    assert found.reasons == ()
    assert verdict(gap_std=0.12).lines[0] == 'the gap is 0.6 ± 0.12, known to 20 % only'


@pytest.mark.parametrize(('changed', 'said'), [
    ({'response_std': 0.8}, 'G, where y moves, is known to 80 %'),
    ({'response_std': 8.0}, 'is known to nothing'),
    ({'c_r_std': 9.0}, 'the middle of the gap is known to ± 9 only'),
])
def test_what_would_mislead_a_controller_is_refused(changed: dict[str, Any], said: str) -> None:
    found = verdict(**changed)
    assert found.backlash.known
    assert said in found.model.reason
    assert found.reasons == (found.model.sentence,)
    assert 'for a controller measure again' in found.lines[1]


@pytest.mark.parametrize(('changed', 'said'), [
    ({'evidence': 3.0}, 'y shows nothing of v'),
    ({'observed': replace(GOOD, gap=5.7)}, 'the gap is at its bound'),
    ({'observed': replace(GOOD, p=GOOD.p * (np.arange(len(V)) > 2700))},
     'went past the gap and back 2 times'),
    ({'rivals': [(0.9, 2.0)]}, 'two gaps fit alike, 0.6 and 0.9'),
    ({'apart': 0.18}, 'other orders or delays fit nearly as well'),
    ({'by_delay': 0.18}, 'the delay may be a longer one'),
    ({'gap_std': 0.18}, 'y has a noise of 0.002, and the gap moves it by 0.48'),
    ({'gap_std': 0.18, 'observed': replace(GOOD, y=0.5 * np.round(GOOD.y / 0.5), noise=0.15)},
     'quantised in steps of 0.5'),
    ({'observed': replace(GOOD, gap=0.01), 'gap_std': 0.1},
     'a gap of up to 0.31 cannot be ruled out'),
    ({'observed': replace(GOOD, gap=0.01), 'gap_std': 0.01, 'gain_std': 0.5},
     'a slow lag looks like a gap'),
])
def test_why_the_gap_is_not_known_is_told_with_the_cure(changed: dict[str, Any], said: str) -> None:
    found = verdict(**changed)
    assert not found.backlash.known
    assert said in found.backlash.reason
    assert found.backlash.cure
    assert found.lines == (
        f'not known: {found.backlash.reason}', f'measure again: {found.backlash.cure}')
    assert found.backlash.sentence in found.reasons


def test_no_backlash_is_said_with_a_bound() -> None:
    o = replace(observed(V, behind(V, 'lag'), 0.0), gap=0.004)
    found = judge(FOUND._replace(observed=o, gap_std=0.004))
    assert found.backlash.known
    assert found.backlash.reason == 'there is no backlash: the gap is below 0.016'


def test_many_small_plays_that_look_like_a_wider_one_are_named() -> None:
    sine = 2.0 * np.sin(0.03 * np.arange(len(V)))
    plays = sum(0.2 * play(sine, width) for width in np.linspace(0.0, 1.2, 5))
    o = observed(sine, behind(plays, 'lag'), 2.0)
    found = judge(FOUND._replace(observed=o))
    assert not found.backlash.known
    assert 'many plays in parallel' in found.backlash.reason


def test_what_no_model_explains_widens_the_deviations_and_then_refuses() -> None:
    rough = observed(V, behind(play(V, GAP), 'lag') + WANDER, GAP, NOISE)
    some = judge(FOUND._replace(observed=rough))
    assert some.backlash.known
    assert some.gap_std > 1.5 * FOUND.gap_std
    assert any('the standard deviations include it' in text for text in some.remarks)
    much = judge(FOUND._replace(observed=rough, gain=0.1))
    assert not much.backlash.known
    assert 'something other than a backlash and a linear G moves y' in much.backlash.reason


def test_what_is_no_play_is_named_first() -> None:
    o = observed(V, behind(dead_zone(V), 'lag'))
    found = judge(FOUND._replace(observed=o, evidence=1.0))
    assert 'a dead zone' in found.backlash.reason
    assert not found.backlash.known


@pytest.mark.parametrize(('kept', 'gap'), [(0.97, 0.5), (0.999, 1e-9)])
def test_a_load_that_coasts_is_told_with_the_gap_that_it_hides(kept: float, gap: float) -> None:
    half, u = 0.5 * GAP, [V[0], V[0]]
    for value in V[1:]:
        # On by what is left of the last step, as far as the sides of the gap let it.
        on = u[-1] + kept * (u[-1] - u[-2])
        u.append(min(max(on, value - half), value + half))
    found = judge(FOUND._replace(observed=observed(V, behind(np.array(u[1:]), 'lag'), gap)))
    assert not found.backlash.known
    reason, _, hidden = found.backlash.reason.partition('the load coasts while v crosses the gap')
    assert reason
    assert float(re.findall(r'[\d.]+', hidden)[0]) == pytest.approx(GAP, rel=0.05)
    assert 'move more slowly' in found.backlash.cure


def test_a_gap_that_changes_is_told_with_its_values_and_widens_the_deviation() -> None:
    u = np.where(np.arange(len(V)) < 1500, play(V, GAP), play(V, 0.8))
    found = judge(FOUND._replace(observed=observed(V, behind(u, 'lag'), 0.7)))
    (said,) = [text for text in found.remarks if 'changes within the record' in text]
    first, _, last = (float(word) for word in said.partition(': ')[2].split(', '))
    assert (first, last) == pytest.approx((0.55, 0.85), abs=0.03)  # the ends of a ramp
    assert found.gap_std > 0.07
    # With orders that fit as well because of it, the change is what is to be known.
    unsure = judge(FOUND._replace(observed=observed(V, behind(u, 'lag'), 0.7), apart=0.5))
    assert not unsure.backlash.known
    assert 'changes within the record' in unsure.backlash.reason


def test_a_smooth_hysteresis_is_no_known_gap_though_a_play_fits_roughly() -> None:
    wind, band = [0.0], 0.3 * GAP  # as of friction by P. R. Dahl
    for step in np.diff(V):
        wind.append(wind[-1] + step - abs(step) * wind[-1] / band)
    y = behind(V - 0.5 * np.array(wind), 'lag')
    found = judge(FOUND._replace(observed=observed(V, y, 0.169)))  # as wide as the best play
    assert not found.backlash.known
    assert 'many plays in parallel' in found.backlash.reason


@pytest.mark.parametrize(('changed', 'said'), [
    ({'gain': -0.8}, 'the gain of G is negative'),
    ({'open_delay': 3}, 'try --delay 3-10'),
    ({'observed': observed(SAW, behind(play(SAW, GAP), 'lag'))}, 'one speed only'),
])
def test_what_to_know_is_remarked(changed: dict[str, Any], said: str) -> None:
    found = verdict(**changed)
    assert found.backlash.known
    assert any(said in text for text in found.remarks)
