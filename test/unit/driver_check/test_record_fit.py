"""A whole record as one function: backlash, G, noise, delay and sign."""

from math import isnan, nan

import numpy as np
import pytest
from records import PERIOD_S, Truth, output, resonance, swing

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.record_fit import RecordFit, fit_record
from backlash_ros.core.records.readings import SEARCHED_AT_MOST

NOISE, TRUTH, MODEL = 1e-3, Truth(), resonance()
BOUNDS = Parameters().estimator.bounds


def record(
    count: int, truth: Truth = TRUTH, model: TransferFunction = MODEL, noise: float = NOISE,
    seed: int = 0, delay: int = 0, size: float = 3.0,
) -> tuple[np.ndarray, np.ndarray]:
    v = swing(count + delay, size, seed)
    y = np.append(nan, output(model, v, truth, noise, seed))
    return v[delay:], y[:count]


def of(v: np.ndarray, y: np.ndarray, uncertainty: float = 0.2, **options: object) -> RecordFit:
    known = {'model': MODEL, 'noise_std': NOISE, **options}
    return fit_record(v, y, uncertainty=uncertainty, **known)


def assert_is(fit: RecordFit, truth: Truth) -> None:
    assert fit.usable, fit.reasons
    told = {**fit.estimates, 'gap': (fit.gap, fit.std_gap)}
    for name, (value, std) in told.items():
        true = getattr(truth, name)
        assert abs(value - true) <= 5.5 * std
        assert std <= 0.02 * abs(true)


@pytest.mark.parametrize('seed', range(4))
def test_backlash_and_noise_are_found(seed: int) -> None:
    m, c_r, c_l, share = np.random.default_rng(seed).uniform(
        [0.2, 0.2, -1.0, 0.0], [5.0, 1.0, -0.2, 1.0]).tolist()
    truth = Truth(m, c_r, c_l, share)
    fit = of(*record(500, truth, seed=seed), 0.2 * (seed % 2))
    assert_is(fit, truth)
    assert fit.fit.noise == pytest.approx(NOISE, rel=0.25)
    assert fit.fit.left.rms == pytest.approx(NOISE, rel=0.25)
    assert fit.predicted > 0.9
    assert (fit.fit.left.correlation, fit.delay) == (0.0, 0)


@pytest.mark.parametrize('delay', [0, 2, 5])
def test_delay_of_v_is_found_by_evidence(delay: int) -> None:
    fit = of(*record(500, delay=delay), 0.0, delays=range(8))
    assert (fit.delay, fit.margins[delay]) == (delay, 0.0)
    assert min(margin for other, margin in fit.margins.items() if other != delay) > 3.0
    assert_is(fit, TRUTH)


def test_a_wrong_sign_is_a_finding_and_not_usable() -> None:
    v, y = record(500)
    right, wrong = of(v, y), of(v, -y)
    values = [{name: value for name, (value, _) in each.estimates.items()}
              for each in (right, wrong)]
    assert values[1] == pytest.approx({**values[0], 'm': -values[0]['m']}, rel=1e-6)
    assert wrong.std_gap == pytest.approx(right.std_gap, rel=1e-3)
    assert not wrong.usable
    assert any('against v' in reason for reason in wrong.reasons)
    assert wrong.doubts == ()


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('ratio', [0.8, 1.2])
def test_a_model_that_is_off_is_learned_with_its_sign(ratio: float, sign: float) -> None:
    true = resonance(5.0 * ratio)
    v, y = record(800, model=true)
    fit = of(v, sign * y)
    assert fit.model is not fit.nominal
    frequencies = 2.0 * np.pi * PERIOD_S * np.array([0.7, 1.9, 3.7])
    z = np.exp(1j * frequencies)
    assert fit.model.response(z) == pytest.approx(true.response(z), rel=5e-3)
    seen = np.abs(true.response(z) / MODEL.response(z) - 1.0)
    assert fit.error_of_model(frequencies) == pytest.approx(seen, rel=0.05)
    assert 0.2 < fit.fit.scale < 5.0
    assert sign * fit.estimates['m'][0] == pytest.approx(TRUTH.m, rel=0.01)
    assert fit.gap == pytest.approx(TRUTH.gap, rel=0.01)


def test_a_long_record_is_fitted_as_a_whole() -> None:
    count = SEARCHED_AT_MOST + 2000
    v, y = record(count)
    v[:1500] = v[1500]  # still at first: the search looks where v moves
    y = np.append(nan, output(MODEL, v, TRUTH, NOISE))[:count]
    fit = of(v, y, 0.0)
    assert_is(fit, TRUTH)
    short = of(v[:SEARCHED_AT_MOST - 2000], y[:SEARCHED_AT_MOST - 2000], 0.0)
    assert fit.std_gap < short.std_gap


@pytest.mark.parametrize('seed', range(3))
def test_one_side_alone_does_not_identify_the_gap(seed: int) -> None:
    v = np.linspace(0.0, 5.0, 400)
    v[0] = v[1] + 1e-5  # a dip that moves the play output by less than anybody can tell
    y = np.append(nan, output(MODEL, v, TRUTH, NOISE, seed))[:400]
    fit = of(v, y, 0.0)
    assert not fit.usable
    assert any('crossed the gap 0 times' in reason for reason in fit.reasons)
    assert fit.estimates['m'][0] == pytest.approx(1.3, rel=0.05)


@pytest.mark.parametrize(('v', 'reason'), [
    (np.zeros(400), 'stood still'), (swing(20), 'too few samples'), (0.05 * swing(400), 'nothing'),
], ids=['still', 'short', 'within the gap'])
def test_why_there_is_no_fit_is_said(v: np.ndarray, reason: str) -> None:
    y = np.append(nan, output(MODEL, v, TRUTH, NOISE))[:len(v)]
    fit = of(v, y)
    assert not fit.usable
    assert reason in fit.reasons[0]
    assert isnan(fit.gap)
    assert isnan(fit.estimates['m'][0])


def test_bounds_limit_what_is_usable() -> None:
    v, y = record(500)
    assert of(v, y, bounds=BOUNDS._replace(m=(0.1, 2.0))).usable
    fit = of(v, y, bounds=BOUNDS._replace(m=(0.1, 1.0)))
    assert any('m would be 1.3, outside' in reason for reason in fit.reasons)
    narrow = of(v, y, bounds=BOUNDS._replace(c_r=(0.0, 0.3), c_l=(-0.3, 0.0)))
    assert not narrow.usable


@pytest.mark.parametrize(('v', 'y', 'delays', 'message'), [
    (np.zeros(5), np.zeros(4), (0,), 'one length'),
    (np.array([0.0, nan, 1.0]), np.zeros(3), (0,), 'v must be finite'),
    (np.zeros(3), np.array([0.0, np.inf, 1.0]), (0,), 'y must be finite'),
    (np.zeros(3), np.zeros(3), (), 'at least one'),
    (np.zeros(3), np.zeros(3), (-1,), 'negative'),
])
def test_arrays_that_make_no_record_are_refused(v, y, delays, message):
    with pytest.raises(ValueError, match=message):
        of(v, y, delays=delays)
