"""Identification from arrays: what is found, how surely, and what a record cannot tell."""

from itertools import islice

import numpy as np
import pytest
from cases import identification_cases
from cases.identification_cases import random_case
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core.control.motion import strokes
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.identification.model import Samples, Structure, Units, first_model, fitted
from backlash_ros.core.identification.structure_search import Options, searched
from backlash_ros.core.plant.backlash import play

Array = NDArray[np.float64]
PERIOD_S = 0.005
SEEDS = (42, 55)  # of the benchmark: delays, one with an integrator
QUICK = Options(orders=(1, 2), delays=(0, 1))


def motion(count: int, reach: float = 3.0, rate: float = 40.0) -> Array:
    return np.array(list(islice(
        strokes(-reach, reach, rate, PERIOD_S, count * PERIOD_S, 0.0), count)))


def record(
    count: int = 1600, gap: float = 0.9, c_r: float = 0.5, noise: float = 2e-3, seed: int = 1,
) -> tuple[Array, Array]:
    v = motion(count)
    return v, answer(v, gap, c_r, noise, seed)


def answer(v: Array, gap: float, c_r: float, noise: float, seed: int = 1) -> Array:
    u = play(v, gap, float(v[0]) + 0.4 * gap) - c_r
    late = np.append([u[0]] * 200, u)
    y = lfilter([0.0, 0.0, 0.03, 0.025], [1.0, -1.7, 0.755], late)
    return np.asarray(y[200:]) + noise * np.random.default_rng(seed).standard_normal(len(v))


@pytest.mark.parametrize('seed', SEEDS)
def test_random_actuators_are_found_to_within_their_deviations(seed: int) -> None:
    case = random_case(seed)
    found = identify(case.v, case.y, case.period)
    assert found.reasons == ()
    assert found.model.integrator == case.integrating
    assert case.delay in found.model.delays
    for name, true in (('gap', case.gap), ('c_r', case.c_r), ('c_l', case.c_l)):
        assert abs(getattr(found, name) - true) < max(4.0 * found.std[name], 1e-9)
    w = found.model.frequencies
    ratio = found.details.response.at(w) * np.exp(-1j * w * found.model.delay) / case.response(w)
    assert np.abs(ratio - 1.0).max() < 0.03


@pytest.mark.parametrize('seed', [1])
def test_rounding_alone_is_no_reason_for_a_further_pole(monkeypatch, seed):
    monkeypatch.setattr(identification_cases, 'NOISE', (1e-300, 1e-300))
    case = random_case(seed)
    found = identify(case.v, case.y, case.period)
    assert len(found.model.denominator) == len(case.denominator)
    assert found.model.denominator == pytest.approx(case.denominator, abs=1e-9)


def test_delays_that_contradict_each_other_where_each_is_sure_leave_the_gentler_one() -> None:
    # By its deviations alone, each of these delays tells all of G.
    case = random_case(1042)
    found = identify(case.v, case.y, case.period, Options((1, 2)))
    assert len(found.model.delays) > 2
    assert found.model.delay == case.delay


def test_no_gap_that_is_told_is_negative() -> None:
    v = motion(1600)
    u = v + 0.04 * np.sign(np.diff(v, prepend=v[0]))
    assert identify(v, answer(u, 0.0, 0.0, 2e-3), PERIOD_S).gap > 0.0


def test_lost_samples_and_outliers_do_not_matter() -> None:
    v, y = record()
    rng = np.random.default_rng(3)
    y[rng.random(len(y)) < 0.1] = np.nan
    wild = rng.choice(np.flatnonzero(np.isfinite(y)), 12, replace=False)
    y[wild] += 5.0
    found = identify(v, y, PERIOD_S, QUICK)
    assert found.model.outliers == 12
    assert found.gap == pytest.approx(0.9, abs=4.0 * found.std['gap'])
    assert found.model.delay == 1
    assert found.model.denominator == pytest.approx((1.0, -1.7, 0.755), abs=0.01)


def test_readings_that_come_twice_make_no_gap_wider() -> None:
    v, y = record()
    again = 1 + np.flatnonzero(np.random.default_rng(3).random(len(y) - 1) < 0.08)
    for k in again:
        y[k] = y[k - 1]
    found = identify(v, y, PERIOD_S, QUICK)
    assert found.model.outliers > 0.6 * len(again)
    assert abs(found.gap - 0.9) < 2.5 * found.std['gap'] < 0.01


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('every', [2, 5])
def test_a_y_that_is_read_every_few_samples_alone_is_enough(every: int) -> None:
    v, y = record()
    y[np.arange(len(y)) % every != 0] = np.nan
    found = identify(v, y, PERIOD_S, QUICK)
    assert found.verdict.backlash.known
    assert found.gap == pytest.approx(0.9, abs=4.0 * found.std['gap'])
    assert found.std['gap'] < 0.02


@pytest.mark.parametrize(('rise', 'seed'), [(0.1, 1), (-0.6, 1), (0.1, 5), (-0.6, 6)])
def test_a_drift_of_y_is_no_part_of_the_gap_and_is_told(rise: float, seed: int) -> None:
    v, y = record(seed=seed)
    found = identify(v, y + np.linspace(0.0, rise, len(y)), PERIOD_S, QUICK)
    assert found.reasons == ()
    assert abs(found.gap - 0.9) < 4.0 * found.std['gap'] < 0.004
    # G has a gain of 1; a drift of y instead of u comes some samples earlier.
    assert found.c_r == pytest.approx(0.5 - rise, abs=3e-3)
    assert found.model.denominator == pytest.approx((1.0, -1.7, 0.755), abs=0.01)
    assert any(remark.startswith(f'c_r and c_l drift by {-rise:.2g} ') for remark in found.remarks)


def test_a_long_rest_does_not_speak_for_another_order() -> None:
    """Its readings share one rounding error, which a higher order may fit by chance."""
    options, v = Options(orders=(2, 3), integrators=(False,)), motion(1600)

    def gain(rest: int) -> float:
        """Gain of the criterion by a third pole if v rests for so long in the end."""
        held = np.append(v, np.full(rest, v[-1]))
        read = 0.02 * np.round(answer(held, 0.9, 0.5, 1e-3, 1) / 0.02)
        samples = Samples(held, read, 0, 0, 0.0, Units())
        two, three = searched(samples, options, (0,), lambda _: None).compared
        return two.criterion - three.criterion

    assert gain(3000) < gain(100) + 10.0


def test_a_first_model_leads_to_the_true_one() -> None:
    v, y = record(noise=0.0, gap=0.9137)
    structure = Structure(2, 1, False)
    samples = Samples(v, y, 3, len(v), 0.0, Units())
    begin = first_model(samples, structure, 0.6, float(v[2]) + 0.3)
    found = fitted(samples, structure, begin.fit)
    assert found.gap == pytest.approx(0.9137, abs=1e-6)
    assert found.denominator == pytest.approx([1.0, -1.7, 0.755], abs=1e-6)
    assert found.numerator == pytest.approx([0.03, 0.025], abs=1e-6)


def test_an_offset_of_y_takes_no_digits_from_it() -> None:
    v, y = record(800)
    near, far = identify(v, y, PERIOD_S, QUICK), identify(v, y + 8e8, PERIOD_S, QUICK)
    assert far.gap == pytest.approx(near.gap, rel=1e-4)
    assert far.model.denominator == pytest.approx(near.model.denominator, abs=1e-3)
    assert far.c_r < -1e8


def reasons(v: Array, y: Array, options: Options = QUICK) -> str:
    found = identify(v, y, PERIOD_S, options)
    assert not found.usable
    return ' '.join(found.reasons)


@pytest.mark.parametrize(('v', 'y', 'said'), [
    (np.zeros(0), np.zeros(0), 'too few'), (np.zeros(3), np.zeros(3), '3 samples of y are too'),
    (np.zeros(900), np.ones(900), 'v stood still'),
    (np.arange(900) % 100 / 10.0, np.ones(900), 'y stood still'),
    (np.arange(900) % 100 / 10.0, np.full(900, np.nan), 'too few'),
    (np.arange(900) % 100 / 10.0, np.where(np.arange(900) < 700, np.nan, 1.0), 'too unevenly'),
    (np.arange(900) % 100 / 10.0, np.where(np.arange(900) < 500, 1.0, np.nan), 'too unevenly'),
])
def test_what_holds_no_motion_is_told_in_a_sentence(v: Array, y: Array, said: str) -> None:
    assert said in reasons(v, y)


@pytest.mark.parametrize(('v', 'y'), [
    (np.zeros(5), np.zeros(4)), (np.full(5, np.nan), np.zeros(5)),
    (np.zeros(5), np.full(5, np.inf)), (np.zeros((5, 2)), np.zeros((5, 2))),
])
def test_arrays_that_are_none_are_refused(v: Array, y: Array) -> None:
    with pytest.raises(ValueError, match='must be'):
        identify(v, y, PERIOD_S)


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from((0.0, 1e-6, 1.0, 1e6)), st.floats(0.0, 0.9))
def test_any_numbers_lead_to_a_result(seed: int, size: float, lost: float) -> None:
    rng = np.random.default_rng(seed)
    v, y = np.cumsum(rng.standard_normal(300)), size * rng.standard_normal(300)
    y[rng.random(300) < lost] = np.nan
    found = identify(v, y, PERIOD_S, Options((1, 2), (0,)))
    assert isinstance(found, Identification)
    assert found.usable == (found.reasons == ())
    assert not found.usable or found.std['gap'] >= 0.0
