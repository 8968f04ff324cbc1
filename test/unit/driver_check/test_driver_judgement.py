"""Each fault of a driver is found once, and with its cure; a good driver has none."""

from __future__ import annotations

import re
from dataclasses import replace
from math import nan

import numpy as np
import pytest
from drivers.made_up_driver import (
    GOOD_GRAPH,
    LIMITS,
    PERIOD_S,
    faults,
    heard_from_driver,
    model,
    parameters,
    subjects,
)
from hypothesis import example, given
from hypothesis import strategies as st

from backlash_ros.core.driver_check.findings import (
    FITS,
    FLOAT64,
    UNKNOWN,
    WRONG,
    Heard,
    graph_findings,
)
from backlash_ros.core.driver_check.gentle_drive import (
    GentleDrive,
    IdentificationDrive,
    Range,
    drive_range,
)
from backlash_ros.core.driver_check.verdict import all_fit, judge, similar_topics, table
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.transfer_function import TransferFunction


def test_a_good_driver_fits_and_its_backlash_is_told() -> None:
    findings = judge(GOOD_GRAPH, heard_from_driver(), Parameters(parameters()))
    assert all_fit(findings), table(findings)
    told = findings[-1].found
    values = [float(part.split(' = ')[1].split(' ±')[0]) for part in told.split(', ')]
    assert values == pytest.approx([1.3, 1.0, -0.8], rel=0.02)


@pytest.mark.parametrize(('graph', 'subject', 'word'), [
    (replace(GOOD_GRAPH, publishers=2), 'publisher', 'stop all but one'),
    (replace(GOOD_GRAPH, publishers=0), 'publisher', 'start the driver'),
    (replace(GOOD_GRAPH, types=('std_msgs/msg/Float32',)), 'type', FLOAT64),
    (replace(GOOD_GRAPH, listeners=0), 'listener', 'subscribe control'),
    (replace(GOOD_GRAPH, listeners=0, near_control=('/m/control',)), 'listener', 'remap'),
    (replace(GOOD_GRAPH, best_effort=True), 'QoS', 'reliable'),
    (replace(GOOD_GRAPH, misfits=('control: durability',)), 'QoS', 'volatile'),
])
def test_a_fault_in_the_graph_is_the_only_one_told(graph, subject, word) -> None:
    found = faults(heard_from_driver(), graph)
    assert subjects(found) == [subject]
    assert word in found[0].cure


def test_best_effort_is_fine_where_the_controller_accepts_it() -> None:
    graph = replace(GOOD_GRAPH, best_effort=True)
    assert [f.mark for f in graph_findings(graph, True)] == [FITS] * 3
    assert WRONG in [f.mark for f in graph_findings(graph, False)]


def test_nothing_is_judged_from_the_mixture_of_two_publishers() -> None:
    findings = judge(
        replace(GOOD_GRAPH, publishers=2), heard_from_driver(), Parameters(parameters())
    )
    assert {f.mark for f in findings if f.subject in ('rate', 'G(z)', 'values')} == {UNKNOWN}
    assert not all_fit(findings)


def test_a_wrong_sample_period_hides_what_follows_from_it() -> None:
    found = faults(heard_from_driver(), sample_period=0.05)
    assert subjects(found) == ['rate']
    assert 'set sample_period' in found[0].cure
    assert '25 Hz' in found[0].found


@pytest.mark.parametrize('made_for', [0.004, 0.2])
def test_a_model_made_for_another_period_is_recognised(made_for: float) -> None:
    numerator, denominator = model(made_for)
    found = faults(
        heard_from_driver(), plant__numerator=numerator, plant__denominator=denominator
    )
    assert subjects(found) == ['G(z)']
    assert f'about {made_for:g} s' in found[0].cure


def test_lost_samples_are_counted_by_number_and_by_time() -> None:
    for renumber in (False, True):
        heard = heard_from_driver()
        kept = [m for k, m in enumerate(heard.outputs) if k % 10 != 5]
        if renumber:
            kept = [m._replace(number=k + 1) for k, m in enumerate(kept)]
        heard.outputs = kept
        found = faults(heard)
        assert subjects(found) == ['lost samples']
        assert found[0].found == '20 of 200 samples'


def test_a_driver_that_falls_silent_loses_samples() -> None:
    heard = heard_from_driver()
    heard.end_ns += int(10 * PERIOD_S * 1e9)
    assert subjects(faults(heard)) == ['lost samples']


def test_samples_that_come_twice_are_told() -> None:
    heard = heard_from_driver()
    heard.outputs = [
        m._replace(stamp_ns=m.stamp_ns + i * 1000, number=2 * m.number + i)
        for m in heard.outputs for i in (0, 1)
    ]
    (found,) = faults(heard)
    assert found.subject == 'repeated samples'
    assert 'came twice' in found.found


def test_a_timer_that_catches_up_is_not_taken_for_a_relay() -> None:
    heard = heard_from_driver()
    # After every twentieth sample the timer was late and makes up for it at once.
    heard.outputs = [
        m._replace(stamp_ns=m.stamp_ns - int(0.9 * PERIOD_S * 1e9)) if k % 20 == 19 else m
        for k, m in enumerate(heard.outputs)
    ]
    found = next(f for f in faults(heard) if f.subject == 'repeated samples')
    assert 'right after the one before' in found.found
    assert 'catching up' in found.cure


def test_a_sensor_slower_than_the_driver_is_told() -> None:
    heard = heard_from_driver()
    heard.outputs = [
        m._replace(value=heard.outputs[k - k % 2].value) for k, m in enumerate(heard.outputs)
    ]
    found = faults(heard, estimator__output_noise_std=0.1)
    assert 'repeated samples' in subjects(found)


@pytest.mark.parametrize('bad', [nan, 1e300])
def test_values_that_are_no_numbers_are_told_and_left_out(bad: float) -> None:
    heard = heard_from_driver()
    heard.outputs[7::10] = [m._replace(value=bad) for m in heard.outputs[7::10]]
    found = faults(heard)
    assert subjects(found) == ['values']
    assert '20 on plant_output' in found[0].found


def test_jitter_is_told_where_samples_come_a_period_late_now_and_then() -> None:
    heard = heard_from_driver()
    late = int(0.7 * PERIOD_S * 1e9)
    for sent in (heard.outputs, heard.controls):
        sent[5::10] = [
            m._replace(stamp_ns=m.stamp_ns + late, received_ns=m.received_ns + late)
            for m in sent[5::10]
        ]
    assert subjects(faults(heard)) == ['jitter']


def test_clocks_that_disagree_hide_what_follows_from_them() -> None:
    heard = heard_from_driver()
    heard.outputs = [m._replace(received_ns=m.stamp_ns - 10**9) for m in heard.outputs]
    found = faults(heard)
    assert subjects(found) == ['clock']
    assert 'synchronise' in found[0].cure


@pytest.mark.parametrize('delay', [1, 5])
def test_a_delay_is_told_in_samples_and_accepted_when_announced(delay: int) -> None:
    heard = heard_from_driver(delay=delay)
    found = faults(heard)
    assert subjects(found) == ['reaction delay']
    assert f'set control.delay_samples: {delay}' in found[0].cure
    assert faults(heard, control__delay_samples=delay) == []


def test_a_delay_before_applied_control_counts_as_one() -> None:
    heard = heard_from_driver(delay=2, report=True)
    found = faults(heard)
    assert subjects(found) == ['reaction delay']
    assert 'set control.delay_samples: 2' in found[0].cure
    assert faults(heard, control__delay_samples=2) == []
    assert faults(heard, estimator__use_applied_control=True) == []


def test_a_limit_inside_the_driver_asks_for_applied_control() -> None:
    heard = heard_from_driver(report=True, limit=3.5)
    found = faults(heard, estimator__use_applied_control=False)
    assert subjects(found) == ['applied_control']
    assert 'estimator.use_applied_control: true' in found[0].cure
    for use in ('true', 'auto'):
        assert faults(heard, estimator__use_applied_control=use) == []


def test_applied_control_that_is_asked_for_and_missing_is_told() -> None:
    found = faults(heard_from_driver(), estimator__use_applied_control=True)
    assert subjects(found) == ['applied_control']
    assert faults(heard_from_driver()) == []


@pytest.mark.parametrize('use', ['auto', 'true'])
def test_applied_control_that_leaves_samples_out_is_told(use: str) -> None:
    heard = heard_from_driver(report=True)
    del heard.applied[::4]
    found = faults(heard, estimator__use_applied_control=use)
    assert subjects(found)[0] == 'applied_control'
    assert 'comes with 75% of the samples' in found[0].found


def test_a_wrong_sign_is_told_and_nothing_else() -> None:
    found = faults(heard_from_driver(sign=-1.0))
    assert subjects(found) == ['sign and units']
    assert 'm would be -1.3' in found[0].found


def test_wrong_units_show_as_a_slope_out_of_bounds() -> None:
    found = faults(heard_from_driver(sign=180.0 / np.pi), estimator__bounds__m=[0.5, 3.0],
                   estimator__output_noise_std=0.1)
    assert subjects(found) == ['sign and units']
    assert 'm would be 74' in found[0].found


def test_noise_larger_than_announced_is_measured() -> None:
    found = faults(heard_from_driver(), estimator__output_noise_std=1e-5)
    assert subjects(found) == ['noise on y']
    measured = float(found[0].cure.split(': ')[1])
    assert measured == pytest.approx(5e-4, rel=0.2)


def test_v_that_stays_within_the_gap_shows_nothing() -> None:
    found = faults(heard_from_driver(reach=0.15))
    assert subjects(found) == ['backlash']
    assert 'wider than the gap' in found[0].cure


def test_v_on_one_side_of_the_gap_does_not_identify_it() -> None:
    found = faults(heard_from_driver(rising=True))
    assert subjects(found) == ['backlash']
    assert 'both directions' in found[0].cure


def test_v_at_rest_or_unknown_asks_for_motion() -> None:
    silent = heard_from_driver()
    silent.controls = []
    resting = heard_from_driver()
    resting.controls = [m._replace(value=0.0) for m in resting.controls]
    for heard in (silent, resting):
        found = faults(heard)
        assert subjects(found) == ['backlash']
        assert '--drive' in found[0].cure


def test_too_few_samples_say_so() -> None:
    assert subjects(faults(Heard())) == ['rate']
    assert subjects(faults(heard_from_driver(samples=30))) == ['backlash']


@pytest.mark.parametrize('ratio', [0.8, 1.2])
def test_a_model_that_is_off_by_a_fifth_fits_and_the_finding_says_how_far(ratio: float) -> None:
    numerator, denominator = model(ratio * PERIOD_S)  # the same as another natural frequency
    findings = judge(GOOD_GRAPH, heard_from_driver(), Parameters(parameters(
        plant__numerator=numerator, plant__denominator=denominator,
    )))
    assert all_fit(findings), table(findings)
    found = next(f.found for f in findings if f.subject == 'G(z)')
    told, true = TransferFunction(numerator, denominator), TransferFunction(*model())
    said = [(float(error) / 100.0, float(frequency)) for error, frequency in
            re.findall(r'([\d.]+)% at ([\d.]+) Hz', found)]
    assert len(said) == 2
    for error, frequency in said:
        z = np.exp([2j * np.pi * frequency * PERIOD_S])
        assert error == pytest.approx(abs(true.response(z) / told.response(z) - 1.0)[0], rel=0.1)


@given(
    st.floats(-20.0, 5.0), st.floats(0.1, 30.0), st.floats(0.1, 200.0), st.floats(-3.0, 3.0),
    st.sampled_from([GentleDrive, IdentificationDrive]),
)
@example(-15.983699780621828, 29.100769855162365, 103.26211025102096, -2.3048063251753783,
         IdentificationDrive)
def test_a_drive_keeps_its_limits_and_comes_to_rest(low, width, rate, start, kind) -> None:
    limits = Range(low, low + width, rate)
    start = min(max(start, limits.low), limits.high)
    drive = kind(limits, 0.01, 2.0, start)
    path = [start] + [drive.step() for _ in range(200)]
    for _ in range(100_000):
        done = drive.step_to_rest()
        path.append(drive.v)
        if done:
            break
    moves = np.abs(np.diff(path))
    assert drive.v == limits.rest
    assert moves.max() <= rate * 0.01 * (1.0 + 1e-9) + 1e-12
    assert min(path) >= limits.low
    assert max(path) <= limits.high


@pytest.mark.parametrize(('limits', 'name'), [
    ({}, 'control.min'), ({'control.min': -1.0}, 'control.max'),
    ({'control.min': -1.0, 'control.max': 1.0}, 'control.rate_max'),
])
def test_drive_without_a_limit_is_refused(limits: dict[str, float], name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        drive_range(Parameters(limits), None, None)


def test_options_narrow_the_limits_and_never_widen_them() -> None:
    p = Parameters(parameters())
    assert drive_range(p, 2.0, 10.0) == Range(-2.0, 2.0, 10.0)
    assert drive_range(p, 100.0, 1000.0) == LIMITS


def test_similar_topics_are_named_first() -> None:
    seen = {
        '/motor/plant_output': [FLOAT64], '/plant_outputs': ['std_msgs/msg/Float32'],
        '/camera/image': ['sensor_msgs/msg/Image'], '/y': [FLOAT64],
    }
    assert similar_topics('/plant_output', FLOAT64, seen) == [
        '/motor/plant_output', '/plant_outputs',
    ]
