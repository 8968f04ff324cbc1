"""What is not a play is named by what it is; a play, whatever G is behind it, is not."""

import pickle
import re
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.judgement import not_play

Array = NDArray[np.float64]

COUNT, GAP, NOISE = 3000, 0.6, 2e-3
K = np.arange(COUNT)
V = 2.0 * np.sin(0.02 * K) + 0.9 * np.sin(0.047 * K + 1.0)
PLANTS: dict[str, tuple[list[float], list[float]]] = {
    'gain': ([0.0, 1.0], [1.0]), 'lag': ([0.0, 0.1], [1.0, -0.9]),
    'two lags': ([0.0, 0.0, 0.02], [1.0, -1.7, 0.72]), 'integrator': ([0.0, 0.02], [1.0, -1.0]),
    'resonance': ([0.0, 0.05, 0.05], [1.0, -1.8, 0.9])}


def play(v: Array, gap: Array | float) -> Array:
    place, out = float(v[0]), []
    for value, half in np.broadcast(v, 0.5 * np.asarray(gap)):
        place = min(max(place, value - half), value + half)
        out.append(place)
    return np.array(out)


def dead_zone(v: Array) -> Array:
    return np.asarray(np.sign(v) * np.maximum(np.abs(v) - 0.4, 0.0))


def behind(u: Array, plant: str, noise: float = NOISE) -> Array:
    numerator, denominator = PLANTS[plant]
    if plant == 'integrator':
        y = lfilter(numerator, denominator, u - u.mean())
    else:
        y = lfilter(numerator, denominator, np.append(np.full(300, u[0]), u))[300:]
    return np.asarray(y + noise * np.random.default_rng(5).standard_normal(len(u)))


def observed(v: Array, y: Array, gap: float = GAP, noise: float = NOISE) -> not_play.Observed:
    p = play(v, gap)
    columns = [np.ones(len(v)), K[:len(v)] * 1e-3, np.cumsum(p - p.mean())]
    columns += [np.append(np.full(k, p[0]), p[:len(p) - k]) for k in range(12)]
    for a in (0.7, 0.9, 0.97, 0.99):
        columns.append(lfilter([1.0 - a], [1.0, -a], p, zi=[a * p[0]])[0])
    whole = np.column_stack(columns)
    known = np.isfinite(y)
    solution = np.linalg.lstsq(whole[known], y[known], rcond=None)[0]
    return not_play.Observed(v, y, p, whole @ solution, noise, gap)


OTHERS: dict[str, tuple[Callable[[Array], Array], str]] = {
    'play, then a load that slides': (
        lambda v: np.clip(play(v, 0.3), -1.5, 1.5), 'the load slides there'),
    'the same on one side': (lambda v: np.minimum(play(v, 0.3), 1.2), 'the load slides there'),
    'dead zone': (dead_zone, 'a dead zone'),
    'compensated already': (lambda v: 2.0 * v - play(v, 0.3), 'the drive compensates'),
    'compensated at once': (
        lambda v: v + 0.15 * np.sign(np.gradient(v)), 'the drive compensates'),
    'plays in parallel': (
        lambda v: 0.3 * v + sum(0.14 * play(v, w) for w in (0.4, 0.9, 1.5, 2.2, 3.0)),
        'plays in parallel')}


def named(o: not_play.Observed) -> str:
    answer = not_play.what_it_is(o)
    assert pickle.loads(pickle.dumps(o)).gap == o.gap
    assert answer.cure
    return answer.reason


@pytest.mark.parametrize('name', OTHERS)
@pytest.mark.parametrize('plant', ['gain', 'two lags'])
def test_another_nonlinearity_is_named(name: str, plant: str) -> None:
    nonlinearity, said = OTHERS[name]
    assert said in named(observed(V, behind(nonlinearity(V), plant)))


def test_a_stick_band_behind_each_turn_is_named_with_its_jump() -> None:
    stop = last = place = float(V[0])
    way, u = 0.0, []
    for value in V.tolist():
        if (value - last) * way < 0.0:
            stop, way = last, 0.0
        if not way and abs(value - stop) > 0.8:
            way = float(np.sign(value - stop))
        place = value - 0.25 * way if way else place
        last = value
        u.append(place)
    reason = named(observed(V, behind(np.array(u), 'lag'), 0.6))
    band, jump = (float(word) for word in re.findall(r'by ([\d.]+)', reason))
    assert (band, jump) == pytest.approx((0.8, 0.3), abs=0.01)


@pytest.mark.parametrize(('plant', 'gap', 'noise'), [
    *((plant, GAP, NOISE) for plant in PLANTS), ('gain', 0.05, NOISE), ('lag', 0.0, NOISE),
    ('two lags', GAP, 0.05), ('integrator', 0.05, NOISE), ('resonance', 0.0, NOISE),
])
def test_a_play_is_nothing_else(plant: str, gap: float, noise: float) -> None:
    o = observed(V, behind(play(V, gap), plant, noise), gap, noise)
    assert not_play.what_it_is(o) is None
    assert not any(test(o) for test, _ in not_play.BESIDE_V)
    assert not_play.best_other(o) is None


@pytest.mark.parametrize('noise', [0.05, 0.3])
def test_noise_that_is_not_white_is_no_nonlinearity(noise: float) -> None:
    wander = lfilter([noise], [1.0, -0.95], np.random.default_rng(8).standard_normal(COUNT))
    o = observed(V, behind(play(V, GAP), 'lag') + wander)
    assert o.unexplained
    assert not_play.what_it_is(o) is None


@pytest.mark.parametrize('side', ['both', 'one'])
def test_a_y_that_is_at_its_end_is_named(side: str) -> None:
    y = np.minimum(behind(play(V, GAP), 'lag', 0.0), 0.9)
    y = np.maximum(y, -0.9 if side == 'both' else -9.0)
    o = observed(V, y + NOISE * np.random.default_rng(1).standard_normal(COUNT))
    assert 'while v goes on by' in named(o)


def test_a_load_that_is_pushed_at_rest_is_named() -> None:
    v = 2.0 * np.round(np.sin(0.01 * K))
    push = 0.3 * ((K % 70) > 45)
    assert 'while v is at rest' in named(observed(v, behind(play(v, GAP), 'lag') + push))
    assert not_play.what_it_is(observed(v, behind(play(v, GAP), 'lag'))) is None


def test_a_y_that_does_not_return_with_v_is_named() -> None:
    u = play(V, GAP)
    moved = np.append(0.0, np.cumsum(np.where(np.diff(u) > 0.0, 1.0, 0.8) * np.diff(u)))
    assert 'y creeps by' in named(observed(V, behind(moved, 'lag')))


@pytest.mark.parametrize('plant', ['gain', 'lag', 'two lags'])
def test_a_gap_that_grows_is_told_from_part_to_part(plant: str) -> None:
    family = not_play.LinearFamily(V, behind(play(V, np.linspace(0.5, 0.8, COUNT)), plant))
    ramp = np.linspace(0.0, 1.0, COUNT)
    gaps, found = family.changing(GAP, np.array([1.0 - ramp, ramp]))
    assert gaps == pytest.approx([0.5, 0.8], abs=0.02)
    assert family.share(found, family.changing(GAP, np.ones((1, COUNT)))[1], NOISE) > 0.5


def test_a_gap_on_a_part_of_the_way_is_told_though_none_fits_best() -> None:
    width = 0.2 * (1.0 + np.cos(1.3 * V))
    family = not_play.LinearFamily(V, behind(play(V, width), 'lag'))
    gaps, _ = family.changing(0.0, np.array([
        np.interp(V, np.linspace(V.min(), V.max(), 5), row) for row in np.eye(5)]))
    assert (gaps.argmax(), gaps[2]) == (2, pytest.approx(0.4, abs=0.1))


def test_nothing_is_left_to_another_where_a_g_that_the_family_does_not_hold_explains_y() -> None:
    p = play(V, GAP)
    rings = lfilter([0.0, 1e-3], np.poly([0.98 + 0.1j, 0.98 - 0.1j, 0.95 + 0.25j, 0.95 - 0.25j]), p)
    y = rings + NOISE * np.random.default_rng(5).standard_normal(len(V))
    o = not_play.Observed(V, y, p, rings, NOISE / 1.2, GAP)
    half = o.one_play._replace(squares=0.5 * o.one_play.squares)
    assert o.family.share(half, o.one_play, o.noise) > 0.45
    assert o.share(half) == 0.0
