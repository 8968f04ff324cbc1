"""Labels of the play operator, filters of the error of G, and the columns made of them."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from math import nan

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from records import resonance
from scipy.signal import lfilter
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR, signals

from backlash_ros.core.estimation.regression.error_model import ErrorFilter, ErrorModel
from backlash_ros.core.estimation.regression.play import Labels, labels_of
from backlash_ros.core.estimation.regression.readings import weights_of
from backlash_ros.core.estimation.regression.regressors import Regressors
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.model_check import ON_CIRCLE
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

MODELS = {
    'resonance': resonance(), 'integrating': TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR),
    'delayed': TransferFunction([0.2, 0.1], [1.0, -0.7, 0.0, 0.0]),
    'no moving pole': TransferFunction([0.5, 0.5], [1.0, 0.0, 0.0]),
}
names = st.sampled_from(sorted(MODELS))
moves = signals(size=10.0, min_size=5)
gaps = st.floats(0.05, 8.0)
shares = st.floats(0.0, 1.0)


@cache
def known(name: str) -> tuple[StateModel, ErrorModel]:
    """A model and its error model."""
    model = StateModel(MODELS[name])
    return model, ErrorModel(model, 0.2)


@given(moves, gaps, shares)
def test_labels_say_what_the_backlash_does(values: list[float], gap: float, share: float) -> None:
    v = np.array(values)
    m, c_r = 1.7, 0.3
    p0 = v[0] + share * gap
    labels = labels_of(v, gap, p0)
    backlash = Backlash(m, c_r, c_r - gap, m * (p0 - c_r))
    u = np.array([backlash.step(value) for value in values])
    assert m * (labels.p - c_r) == pytest.approx(u, abs=1e-9)
    # What the regression makes of them is the same u.
    by_labels = m * (labels.v_a - c_r * labels.right - (c_r - gap) * labels.left) \
        + labels.held * m * (p0 - c_r)
    assert by_labels == pytest.approx(u, abs=1e-9)
    assert np.all(labels.right + labels.left + labels.held == 1.0)
    assert labels.p == pytest.approx(p0 + np.cumsum(labels.moves + labels.jump * (
        labels.p - np.append(p0, labels.p[:-1])
    )), abs=1e-9)
    assert labels.jump.sum() == float(np.any(labels.held == 0.0))


def in_pieces(v: np.ndarray, gap: float, p0: float, cuts: list[int]) -> list[Labels]:
    """Labels of pieces, each begun where the one before it ended."""
    found = []
    p, side, v_a = p0, 0, 0.0
    for part in np.split(v, sorted(cuts)):
        if len(part):
            labels = labels_of(part, gap, p, side, v_a)
            p, v_a = float(labels.p[-1]), float(labels.v_a[-1])
            side = int(labels.right[-1] - labels.left[-1])
            found.append(labels)
    return found


@given(moves, gaps, shares, st.data())
def test_labels_in_pieces_are_those_of_one(
    values: list[float], gap: float, share: float, data: st.DataObject,
) -> None:
    v = np.array(values)
    cuts = data.draw(st.lists(st.integers(0, len(v)), max_size=4))
    whole = labels_of(v, gap, v[0] + share * gap)
    parts = in_pieces(v, gap, v[0] + share * gap, cuts)
    for name in Labels._fields:
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert joined == pytest.approx(getattr(whole, name), abs=1e-12), name


@given(moves, gaps, shares)
def test_reversals_count_changes_of_the_side(
    values: list[float], gap: float, share: float,
) -> None:
    labels = labels_of(np.array(values), gap, values[0] + share * gap)
    sides = [r - le for r, le, h in zip(labels.right, labels.left, labels.held, strict=True)
             if h == 0.0]
    assert labels.reversals == sum(a != b for a, b in pairwise(sides))


@given(names, moves, st.data())
def test_error_filter_in_pieces_equals_one_piece(
    name: str, values: list[float], data: st.DataObject,
) -> None:
    error = known(name)[1]
    moves_of_p = np.array([values])
    cuts = data.draw(st.lists(st.integers(0, len(values)), max_size=4))
    running = ErrorFilter(error, 1)
    pieces = [part for part in np.split(moves_of_p, sorted(cuts), axis=1) if part.size]
    parts = [running.responses(part) for part in pieces]
    whole = ErrorFilter(error, 1).responses(moves_of_p)
    joined = np.concatenate(parts, axis=2)
    assert joined == pytest.approx(whole, abs=1e-9 * (1.0 + np.abs(whole).max()))


def of_error(name: str, h: np.ndarray, moves_of_u: np.ndarray) -> np.ndarray:
    """G (1 - z^-1) sum h_i F_i applied to u, from the formulas of the F_i."""
    transfer = MODELS[name]
    poles = transfer.poles
    moving = poles[(np.abs(poles) > ON_CIRCLE) & (np.abs(poles) < 1.0 - ON_CIRCLE)]
    a = np.atleast_1d(np.real(np.poly(moving)))
    b = np.trim_zeros(transfer.numerator, 'fb')
    shorter = np.atleast_1d(np.poly([-1.0] * max(len(b) - 2, 0)))
    wide = np.convolve(b.sum() * shorter / shorter.sum(), [1.0, -1.0])
    late = np.zeros(transfer.delay)
    taps = [
        (np.append(late, -b), [1.0]), (np.append(late, wide), [1.0]),
        *((np.concatenate([late, np.zeros(j), a.sum() * b]), a) for j in range(len(a) - 1)),
    ]
    total = np.zeros(len(moves_of_u) + 1)
    for weight, (numerator, stable) in zip(h, taps, strict=True):
        total += weight * lfilter(
            numerator, np.convolve(transfer.denominator, stable), np.append(moves_of_u, 0.0)
        )
    return total[1:]


@given(names, moves, gaps, shares, st.booleans(), st.integers(0, 1000))
def test_columns_times_unknowns_are_the_output_of_an_uncertain_plant(
    name: str, values: list[float], gap: float, share: float, jump: bool, seed: int,
) -> None:
    model, error = known(name)
    v = np.array(values)
    rng = np.random.default_rng(seed)
    m, c_r = 1.7, 0.3
    x0, a = rng.standard_normal(model.order), rng.standard_normal(error.count)
    p0 = v[0] + share * gap
    labels = labels_of(v, gap, p0)
    assume(jump or not labels.jump.any())
    regressors = Regressors(model, error, jump)
    layout = regressors.layout
    u = m * (labels.p - c_r)
    # G u and G (1 - z^-1) sum h F u; the state is followed sample by sample.
    added = of_error(name, error.spread @ a, np.diff(u, prepend=m * (p0 - c_r)))
    x, y = x0, []
    for value in u:
        x = model.a @ x + model.b * value
        y.append(model.c * x[0])
    y = np.array(y) + added
    unknowns = np.zeros(layout.unknowns)
    unknowns[:layout.n] = x0
    unknowns[layout.n] = m * (p0 - c_r)
    unknowns[layout.theta] = m, m * c_r, m * (c_r - gap)
    unknowns[layout.base:layout.base + layout.errors] = m * a
    if layout.jump:
        size = float((labels.jump * (labels.p - np.append(p0, labels.p[:-1]))).sum())
        unknowns[layout.unknowns - layout.errors:] = m * a * size
    rows = regressors.rows(labels, y)
    assert rows @ unknowns == pytest.approx(y, abs=1e-7 * (1.0 + np.abs(y).max()))
    # What the state is a linear function of.
    without = Regressors(model, error, jump)
    without.rows(labels, y)
    by_map = without.state_map() @ unknowns[:without.state_map().shape[1]]
    assert by_map == pytest.approx(x, abs=1e-7 * (1.0 + np.abs(x).max()))


@given(names, moves, gaps, shares, st.data())
def test_columns_in_pieces_equal_columns_in_one(
    name: str, values: list[float], gap: float, share: float, data: st.DataObject,
) -> None:
    model, error = known(name)
    v = np.array(values)
    cuts = data.draw(st.lists(st.integers(0, len(v)), max_size=4))
    p0 = v[0] + share * gap
    y = np.where(np.arange(len(v)) % 3 == 2, nan, v + 1.0)
    whole = Regressors(model, error, jump=True).rows(labels_of(v, gap, p0), y)
    running = Regressors(model, error, jump=True)
    parts, done = [], 0
    for labels in in_pieces(v, gap, p0, cuts):
        parts.append(running.rows(labels, y[done:done + len(labels.p)]))
        done += len(labels.p)
    assert np.concatenate(parts) == pytest.approx(whole, abs=1e-9 * (1.0 + np.abs(whole).max()))


def test_leak_of_an_integrator_is_a_column() -> None:
    leak, count = 1e-4, 200
    lag = [1.0, -0.9]
    told, leaky = (
        TransferFunction([0.05], np.convolve([1.0, -pole], lag).tolist())
        for pole in (1.0, 1.0 - leak)
    )
    model = StateModel(told)
    v = 3.0 * np.sin(0.1 * np.arange(count))
    labels = labels_of(v, 1.0, v[0])
    m, c_r = 1.7, 0.3
    u = m * (labels.p - c_r)
    y, ideal = (
        lfilter(g.numerator, g.denominator, np.append(u, 0.0))[1:] for g in (leaky, told)
    )
    regressors = Regressors(model, ErrorModel(model, 0.2), jump=True)
    rows, layout = regressors.rows(labels, y), regressors.layout
    assert layout.leak
    unknowns = np.zeros(layout.unknowns)
    unknowns[layout.n] = m * (v[0] - c_r)
    unknowns[layout.theta] = m, m * c_r, m * (c_r - 1.0)
    unknowns[layout.driven] = leak
    assert np.abs(rows @ unknowns - y).max() <= 0.05 * np.abs(ideal - y).max()


def test_prior_of_the_error_is_as_wide_as_plants_around_the_model() -> None:
    name = 'resonance'
    error = known(name)[1]
    z = np.exp([0.2j])
    expected = np.linalg.norm(error.responses(z))
    rng = np.random.default_rng(3)
    told = MODELS[name].response(z)[0]
    off = np.exp(0.2 * rng.standard_normal((400, 2)))
    others = [resonance(5.0 * frequency, 0.5 * damping) for frequency, damping in off]
    seen = np.sqrt(np.mean([abs(g.response(z)[0] / told - 1.0) ** 2 for g in others]))
    assert expected == pytest.approx(seen, rel=0.25)


def test_exact_model_has_no_error_terms() -> None:
    assert ErrorModel(known('resonance')[0], 0.0).count == 0


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, nan]), min_size=1, max_size=40))
def test_weights_share_one_among_readings_that_repeat(values: list[float]) -> None:
    y = np.array(values)
    weights = weights_of(y)
    runs = 1 + sum(a != b for a, b in pairwise(values))
    assert weights.sum() == pytest.approx(runs)
    for k in range(1, len(y)):
        if y[k] == y[k - 1]:
            assert weights[k] == weights[k - 1]
