"""The fit of the first samples, and what the search for the gap makes of it."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import output_of

from backlash_ros.core.assembly import build_model, build_state_model
from backlash_ros.core.backlash import Backlash
from backlash_ros.core.early_fits import MOST_MISFITS, EarlyFits
from backlash_ros.core.gap_bank import GapBank, Noise, Prior, Start
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.record_search import MISFIT, RecordOptimum, RecordSearch
from backlash_ros.core.transfer_function import TransferFunction

NOISE = 1e-3
WIDEST = 200.0
MODEL = build_model(Parameters())


def record(
    v: np.ndarray, m: float, c_r: float, c_l: float, u: float, seed: int = 0,
    model: TransferFunction = MODEL,
) -> np.ndarray:
    """y (N,) of a model, the example's unless told, at rest before; v acts before each y."""
    backlash = Backlash(m, c_r, c_l, u)
    # The newest u does not show in y yet, so one more makes way for it.
    held = [backlash.step(value) for value in v.tolist()]
    y = output_of(model, np.array([*held, 0.0]))[1:]
    return y + NOISE * np.random.default_rng(seed).standard_normal(len(v))


def search(
    y: np.ndarray, v: np.ndarray, hint: RecordOptimum | None = None,
    model: TransferFunction = MODEL,
) -> RecordOptimum | None:
    """The optimum of a finished search."""
    running = RecordSearch(model, y, v, NOISE, WIDEST, hint)
    while not running.advance():
        pass
    return running.optimum


def swing(count: int, size: float) -> np.ndarray:
    """A slow v that turns."""
    return size * np.sin(0.05 * np.arange(count)) * np.linspace(0.3, 1.0, count)


@given(
    m=st.floats(0.3, 5.0), c_r=st.floats(0.5, 5.0), c_l=st.floats(-5.0, -0.5),
    share=st.floats(0.0, 1.0), seed=st.integers(0, 1000),
)
def test_gap_slope_and_reach_are_found_within_their_deviations(
    m: float, c_r: float, c_l: float, share: float, seed: int,
) -> None:
    gap = c_r - c_l
    v = swing(200, 2.0 * gap)
    u = m * (v[0] - c_r) + share * m * gap
    found = search(record(v, m, c_r, c_l, u, seed=seed), v)
    assert found is not None
    assert found.misfit < MISFIT
    assert found.std_gap < 0.1 * gap
    assert abs(found.gap - gap) < 5.0 * found.std_gap
    assert abs(found.m - m) < 5.0 * found.std_m


def test_samples_before_the_first_engagement_count() -> None:
    # v meets the second side with the last samples only: what u was held at before tells the rest.
    v = np.concatenate([np.linspace(0.0, 4.0, 60), np.linspace(4.0, -4.5, 120)])
    met = int(np.argmax(v[60:] < 4.0 - 6.0)) + 60
    y = record(v, 1.3, 3.0, -3.0, 0.0)
    found = search(y[: met + 30], v[: met + 30])
    assert found is not None
    assert found.gap == pytest.approx(6.0, rel=0.01)
    assert found.std_gap < 0.06


def test_gap_of_which_one_side_alone_was_met_is_not_known() -> None:
    v = np.concatenate([np.linspace(0.0, 6.0, 60), np.linspace(6.0, 5.0, 60)])
    found = search(record(v, 1.3, 3.0, -3.0, 0.0), v)
    assert found is None or found.std_gap > 0.5


def test_lost_samples_are_left_out() -> None:
    v = swing(200, 10.0)
    y = record(v, 1.3, 3.0, -3.0, 0.0)
    y[::3] = nan
    found = search(y, v)
    assert found is not None
    assert found.gap == pytest.approx(6.0, rel=0.01)


def test_hint_leads_to_the_optimum_of_more_samples() -> None:
    v = swing(300, 10.0)
    y = record(v, 1.3, 3.0, -3.0, 0.0)
    hint, cold = search(y[:150], v[:150]), search(y, v)
    warm = search(y, v, hint)
    assert hint is not None
    assert cold is not None
    assert warm is not None
    assert abs(warm.gap - cold.gap) < warm.std_gap
    assert warm.std_gap < hint.std_gap


def test_record_without_motion_or_too_short_has_no_optimum() -> None:
    assert search(np.zeros(5), np.arange(5.0)) is None
    fits = EarlyFits(MODEL, WIDEST, 0.01)
    fits.begin(np.zeros(5), np.arange(5.0), NOISE)
    assert fits.advance(5) is None
    assert not fits.running


def test_record_of_another_plant_is_given_up() -> None:
    v = swing(200, 10.0)
    y = record(v, 1.3, 3.0, -3.0, 0.0)
    y[100:] *= -1.0
    fits = EarlyFits(MODEL, WIDEST, 0.01)
    for _ in range(MOST_MISFITS):
        assert fits.possible(len(y))
        fits.begin(y, v, NOISE)
        while fits.running:
            assert fits.advance(len(y)) is None
    assert not fits.possible(len(y))


def test_slower_loops_may_do_more_per_sample() -> None:
    v = swing(200, 10.0)
    y = record(v, 1.3, 3.0, -3.0, 0.0)

    def samples(period: float) -> int:
        fits, count = EarlyFits(MODEL, WIDEST, period), 0
        fits.begin(y, v, NOISE)
        while fits.running:
            fits.advance(len(y))
            count += 1
        return count

    assert samples(0.01) < samples(0.005)
    assert EarlyFits(MODEL, WIDEST, 0.005).possible(len(y))
    assert not EarlyFits(MODEL, WIDEST, 0.001).possible(len(y))


@pytest.mark.parametrize('reach', [2.0, 3.0, 4.0])
def test_bank_that_starts_at_once_equals_least_squares(reach: float) -> None:
    v, p = swing(150, 5.0), Parameters()
    y = record(v, 1.3, 3.0, -3.0, 0.0)
    bank = GapBank(
        np.array([6.0]), build_state_model(p), Prior(np.array([1.0, 1.0, -1.0]), 30.0),
        Noise(NOISE), start=Start(np.array([reach]), float(np.ptp(y)), float(np.abs(v).max())),
    )
    for value, output in zip(v, y, strict=True):
        bank.predict(value)
        bank.correct(output)
    expected = _least_squares(y, v, 6.0, reach)
    assert bank.theta[0] == pytest.approx(expected, rel=1e-3)


def _least_squares(y: np.ndarray, v: np.ndarray, gap: float, reach: float) -> np.ndarray:
    """(m, m c_r, m c_l) from all samples at once, by responses of G simulated one by one."""
    a, b, c = MODEL.state_space()

    def response(u: np.ndarray, x: np.ndarray) -> np.ndarray:
        out = []
        for value in u:
            x = a @ x + b * value
            out.append(c @ x)
        return np.array(out)

    on_left, q = np.zeros(len(v)), np.zeros(len(v))
    side = 0.0
    for k, value in enumerate(v):
        if reach >= value + gap:
            reach, side = value + gap, 1.0
        elif reach <= value:
            reach, side = value, 0.0
        q[k], on_left[k] = reach - side * gap, side
    none, zero = np.zeros(len(v)), np.zeros(MODEL.order)
    columns = [response(q, zero), response(on_left - 1.0, zero), response(-on_left, zero)]
    columns += [response(none, axis) for axis in np.eye(MODEL.order)]
    return np.linalg.lstsq(np.column_stack(columns), y, rcond=None)[0][:3]


def test_zero_in_front_of_the_numerator_is_a_delay() -> None:
    late = TransferFunction([1.0], [1.0, -0.9, 0.0])
    v = swing(200, 10.0)
    found = search(record(v, 1.3, 3.0, -3.0, 0.0, model=late), v, model=late)
    assert found is not None
    assert found.gap == pytest.approx(6.0, rel=1e-3)
