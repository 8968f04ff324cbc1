"""Counts of a loop, lines of the log, period of a driver, joints, samples for the fits."""

from collections.abc import Iterable, Mapping
from math import isnan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimation.estimator import Recorder
from backlash_ros.core.loop.diagnosis import AGAIN_S, LASTS_S, Finding, Level, LevelLog
from backlash_ros.core.loop.loop_statistics import Lately, LoopStatistics
from backlash_ros.core.loop.sample_counter import DriverPeriod
from backlash_ros.core.parameters import ParameterError, Parameters


def test_what_was_gained_lately_is_never_negative_after_a_new_beginning() -> None:
    lately = Lately()
    for t in range(10):
        gained = lately.gained({'used': 100 * t, 'lost': 0}, float(t))
    assert gained['used'] > 100
    assert lately.gained({'used': 40, 'lost': 3}, 10.0) == {'used': 40, 'lost': 3}
    assert lately.gained({'used': 90, 'lost': 3}, 11.0) == {'used': 50, 'lost': 0}


def noted(values: list[float], still_band: float = 0.0) -> LoopStatistics:
    statistics = LoopStatistics(still_band=still_band)
    for k, y in enumerate(values):
        statistics.note(y, float(k % 5), False, False, 0.0)
    return statistics


def test_a_y_that_moves_within_its_noise_stands_still() -> None:
    noise = (1e-3 * np.random.default_rng(1).normal(size=100)).tolist()
    assert (noted(noise).still, noted(noise, 6e-3).still) == (1, 100)
    assert (noted(noise, 6e-3).still_swing, noted([*noise, 0.1], 6e-3).still) == (4.0, 1)


def test_an_angle_that_wraps_is_told_from_one_that_moves_fast() -> None:
    turning = 0.05 * np.arange(400.0)
    assert noted(turning.tolist()).wraps == 0
    assert noted(((turning + np.pi) % (2.0 * np.pi) - np.pi).tolist()).wraps == 3
    assert noted((6.2832 * np.arange(50.0)).tolist()).wraps == 0


WELL = Finding(Level.OK, 'learned', 'learned')
WRONG = Finding(Level.ERROR, 'model', 'the model is wrong')
WAITING = Finding(Level.WARN, 'waiting', 'waiting', lasting=True)


def lines_of(findings: list[tuple[float, Finding]]) -> list[tuple[Level, str]]:
    lines: list[tuple[Level, str]] = []
    log = LevelLog(lambda level, text: lines.append((level, text)))
    for now_s, finding in findings:
        log.take(finding, now_s)
    return lines


def test_a_change_of_level_is_one_line_and_one_when_all_is_well_again() -> None:
    findings = [(float(t), WRONG if 5 <= t < 20 else WELL) for t in range(40)]
    assert lines_of(findings) == [
        (Level.ERROR, 'the model is wrong'), (Level.OK, 'recovered: learned')]


def test_what_comes_and_goes_is_told_once_per_while() -> None:
    findings = [(0.5 * n, WRONG if n % 2 else WELL) for n in range(50)]
    assert lines_of(findings) == [(Level.ERROR, 'the model is wrong')]
    slowly = [(0.1 * n, WRONG if n // 30 % 2 else WELL) for n in range(600)]
    told = lines_of(slowly)
    assert len(told) <= 2 * (60.0 / AGAIN_S + 1)
    assert {text for _, text in told} == {'the model is wrong', 'recovered: learned'}


def test_what_passes_by_itself_is_told_once_it_has_lasted() -> None:
    assert lines_of([(0.0, WAITING), (LASTS_S / 2.0, WAITING), (LASTS_S, WELL)]) == []
    assert lines_of([(0.0, WAITING), (LASTS_S, WAITING)]) == [(Level.WARN, 'waiting')]


def test_trouble_that_was_not_told_is_not_told_to_be_over() -> None:
    assert lines_of([(0.0, WAITING), (1.0, WELL), (20.0, WELL)]) == []


def stamped(ticks: Iterable[float], period_s: float) -> DriverPeriod:
    sender = DriverPeriod(period_s)
    for tick in ticks:
        sender.follow(1_800_000_000_000_000_000 + round(tick * period_s * 1e9))
    return sender


@pytest.mark.parametrize('nominal_s', [0.02, 0.002])
@pytest.mark.parametrize('slow', [-0.05, 0.005, 0.059])
@pytest.mark.parametrize(('lost', 'twice', 'jitter'), [
    (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.1, 0.0, 0.05), (0.0, 0.1, 0.05),
])
def test_the_period_of_a_driver_is_known_to_a_thousandth_after_a_second(
    nominal_s: float, slow: float, lost: float, twice: float, jitter: float,
) -> None:
    rng = np.random.default_rng(5)
    ticks = []
    for k in range(round(1.0 / nominal_s)):
        if rng.random() >= lost:
            ticks.append(k * (1.0 + slow) + jitter * rng.random())
            if rng.random() < twice:
                ticks.append(ticks[-1] + 0.01)
    period = stamped(ticks, nominal_s).newest()
    tolerance = 1e-3 if jitter < 0.2 else 4e-3 * nominal_s / 0.02
    assert abs(period.mean / nominal_s - 1.0 - slow) < max(tolerance, 1e-3)
    assert abs(period.mean / nominal_s - 1.0 - slow) * nominal_s < 3.0 * period.std + 1e-6


@pytest.mark.parametrize('ticks', [[0.5 * k for k in range(100)], [3.0 * k for k in range(100)],
                                   range(20), [0.0] * 100])
def test_no_period_is_told_of_messages_that_are_no_samples(ticks: Iterable[float]) -> None:
    assert isnan(stamped(ticks, 0.01).newest().mean)


def test_of_a_driver_that_is_held_up_all_the_time_no_period_is_told() -> None:
    rng = np.random.default_rng(1)
    ticks = [k + 0.75 * rng.random() for k in range(400) if rng.random() < 0.6]
    assert isnan(stamped(ticks, 0.01).newest().mean)


ARM: dict[str, object] = {
    'joints': ['waist', 'elbow', 'wrist'], 'sample_period': 0.02, 'control.rate_max': 2.0,
    'estimates.file': 'saved/arm.json',
    'waist.plant.numerator': [0.5], 'waist.plant.denominator': [1.0, -0.5],
    'waist.control.rate_max': 1.0, 'elbow.plant.numerator': [0.2],
    'elbow.plant.denominator': [1.0, -0.8], 'elbow.structure': 'tracking',
}


def of(**changes: object) -> Parameters:
    return Parameters({**ARM, **{name.replace('__', '.'): v for name, v in changes.items()}})


def test_a_joint_has_its_own_value_else_the_shared_one_else_the_default() -> None:
    waist, elbow = of().of_joint('waist'), of().of_joint('elbow')
    assert (waist['control.rate_max'], elbow['control.rate_max']) == (1.0, 2.0)
    assert (waist['structure'], elbow['structure']) == ('proportional', 'tracking')
    assert waist['sample_period'] == elbow['sample_period'] == 0.02
    assert waist['plant.denominator'] == (1.0, -0.5)
    assert waist['io.joint'] == 'waist'
    assert waist['joints'] == ()


def test_a_joint_that_nobody_describes_passes_its_reference_through() -> None:
    wrist = of().of_joint('wrist')
    assert (wrist['estimator.law'], wrist['structure']) == ('fixed', 'proportional')
    assert [wrist[f'estimator.initial.{name}'] for name in ('m', 'c_r', 'c_l')] == [1.0, 0.0, 0.0]
    assert wrist['control.rate_max'] == 2.0
    shared = of(plant__denominator=[1.0, -0.9], plant__numerator=[0.1]).of_joint('wrist')
    assert shared['estimator.law'] == 'moving_horizon'
    assert shared['plant.denominator'] == (1.0, -0.9)


@pytest.mark.parametrize(('file', 'of_waist'), [
    ('saved/arm.json', 'saved/arm-waist.json'), ('{joint}/e.json', 'waist/e.json'), ('', ''),
])
def test_each_joint_saves_into_a_file_of_its_own(file: str, of_waist: str) -> None:
    assert of(estimates__file=file).of_joint('waist')['estimates.file'] == of_waist


@pytest.mark.parametrize(('changes', 'said'), [
    ({'waist.plant.numerators': [1.0]}, 'waist.plant.numerators is not a parameter: did you mean '
     'plant.numerator?'),
    ({'elbo.plant.numerator': [1.0]}, 'did you mean elbow.plant.numerator?'),
    ({'waist.control.rate_max': -1.0}, 'waist.control.rate_max=-1.0 must be > 0'),
    ({'control.rate_max': -1.0}, 'control.rate_max=-1.0 must be > 0'),
    ({'waist.sample_period': 0.1}, 'waist.sample_period=0.1 is not for one joint alone: set '
     'sample_period'),
    ({'waist.seed': 2}, 'waist.seed=2 is not for one joint alone: set seed'),
    ({'joints': ['plant']}, "joints='plant' is the first word of a parameter"),
    ({'joints': ['a b']}, 'must be a list of names'),
    ({'joints': ['waist', 'waist']}, 'must be a list of names'),
])
def test_mistakes_name_the_joint(changes: Mapping[str, object], said: str) -> None:
    with pytest.raises(ParameterError) as error:
        Parameters({**ARM, **changes})
    assert said in str(error.value)


def test_changes_reach_the_joints_that_have_no_value_of_their_own() -> None:
    changed = of().replaced({'control.rate_max': 3.0, 'elbow.structure': 'proportional'})
    assert changed.of_joint('waist')['control.rate_max'] == 1.0
    assert changed.of_joint('wrist')['control.rate_max'] == 3.0
    assert changed.of_joint('elbow')['structure'] == 'proportional'


@given(counts=st.lists(st.integers(0, 300), max_size=12), capacity=st.integers(1, 500),
       needed=st.integers(0, 2000))
def test_a_fit_sees_the_newest_samples_it_needs_with_their_numbers(counts, capacity, needed):
    recorder, seen = Recorder(capacity), []
    end = 0
    for count in counts:
        for k in range(end, end + count):
            recorder.append(k, -k, 0.5)
        end += count
        first = min(max(end - capacity, needed), end)
        seen.append((first, end, recorder.since(first)))
    for first, end, window in seen:
        numbers = list(range(first, end))
        assert (window.first, window.end) == (first, end)
        assert (window.v.tolist(), window.y.tolist()) == (numbers, [-k for k in numbers])
