"""Each fault of a driver is found once, and with its cure; a good driver has none."""

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from math import nan

import numpy as np
import pytest
from drivers import made_up_driver as made
from hypothesis import example, given
from hypothesis import strategies as st

from backlash_ros.core.control.limits import Limits
from backlash_ros.core.control.motion import Drive, drive_limits
from backlash_ros.core.driver_check import FLOAT64, UNKNOWN, Heard, Message, all_fit, judge, table
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.nodes.check_driver import similar_topics


def test_a_good_driver_fits_and_its_backlash_is_told() -> None:
    findings = judge(made.GOOD_GRAPH, made.heard_from_driver(), Parameters(made.parameters()))
    assert all_fit(findings), table(findings)
    told = findings[-1].found
    values = [float(part.split(' = ')[1].split(' ±')[0]) for part in told.split(', ')]
    assert values == pytest.approx([1.3, 1.0, -0.8], rel=0.02)


@pytest.mark.parametrize(('graph', 'subject', 'word'), [
    (replace(made.GOOD_GRAPH, publishers=2), 'publisher', 'stop all but one'),
    (replace(made.GOOD_GRAPH, publishers=0), 'publisher', 'start the driver'),
    (replace(made.GOOD_GRAPH, types=('std_msgs/msg/Float32',)), 'type', FLOAT64),
    (replace(made.GOOD_GRAPH, listeners=0), 'listener', 'subscribe control'),
    (replace(made.GOOD_GRAPH, listeners=0, near_control=('/m/control',)), 'listener', 'remap'),
    (replace(made.GOOD_GRAPH, best_effort=True), 'QoS', 'reliable'),
    (replace(made.GOOD_GRAPH, misfits=('control: durability',)), 'QoS', 'volatile'),
])
def test_a_fault_in_the_graph_is_the_only_one_told(graph, subject, word) -> None:
    found = made.faults(made.heard_from_driver(), graph)
    assert made.subjects(found) == [subject]
    assert word in found[0].cure


def test_best_effort_is_fine_where_the_controller_accepts_it() -> None:
    graph = replace(made.GOOD_GRAPH, best_effort=True)
    assert made.faults(made.heard_from_driver(), graph, io__best_effort=True) == []


def test_nothing_is_judged_from_the_mixture_of_two_publishers() -> None:
    graph = replace(made.GOOD_GRAPH, publishers=2)
    findings = judge(graph, made.heard_from_driver(), Parameters(made.parameters()))
    assert {f.mark for f in findings if f.subject in ('rate', 'G(z)', 'values')} == {UNKNOWN}
    assert not all_fit(findings)


LATE_NS = int(0.7 * made.PERIOD_S * 1e9)


def shifted(messages: list[Message], stamp_ns: int, received_ns: int) -> list[Message]:
    return [m._replace(stamp_ns=m.stamp_ns + stamp_ns, received_ns=m.received_ns + received_ns)
            for m in messages]


def with_outputs(change: Callable[[list[Message]], list[Message]]) -> Heard:
    heard = made.heard_from_driver()
    heard.outputs = change(heard.outputs)
    return heard


def some_lost(outputs: list[Message]) -> list[Message]:
    return [m for k, m in enumerate(outputs) if k % 10 != 5]


def twice(outputs: list[Message]) -> list[Message]:
    return [m._replace(stamp_ns=m.stamp_ns + i * 1000, number=2 * m.number + i)
            for m in outputs for i in (0, 1)]


def bad_values(bad: float) -> Heard:
    return with_outputs(lambda sent: [
        m._replace(value=bad) if k % 10 == 7 else m for k, m in enumerate(sent)])


def fallen_silent() -> Heard:
    heard = made.heard_from_driver()
    heard.end_ns += int(10 * made.PERIOD_S * 1e9)
    return heard


def late_now_and_then() -> Heard:
    heard = made.heard_from_driver()
    for sent in (heard.outputs, heard.controls):
        sent[5::10] = shifted(sent[5::10], LATE_NS, LATE_NS)
    return heard


def with_controls(value: float | None) -> Heard:
    heard = made.heard_from_driver()
    heard.controls = [m._replace(value=value) for m in heard.controls if value is not None]
    return heard


def reports_with_holes() -> Heard:
    heard = made.heard_from_driver(report=True)
    del heard.applied[::4]
    return heard


NUMERATOR, DENOMINATOR = made.model(0.004)
NEAR = made.model(1.4 * made.PERIOD_S)  # another natural frequency


@pytest.mark.parametrize(('heard', 'changes', 'subject', 'told'), [
    (made.heard_from_driver, {'sample_period': 0.05}, 'rate', ['25 Hz', 'set sample_period']),
    (made.heard_from_driver, {'plant__numerator': NUMERATOR, 'plant__denominator': DENOMINATOR},
     'G(z)', ['discretised']),
    (made.heard_from_driver, {'plant__numerator': NEAR[0], 'plant__denominator': NEAR[1],
                              'plant__uncertainty': 0.05}, 'G(z)', ['raise plant.uncertainty']),
    (lambda: with_outputs(some_lost), {}, 'lost samples', ['20 of 200 samples']),
    (lambda: with_outputs(
        lambda sent: [m._replace(number=k + 1) for k, m in enumerate(some_lost(sent))]
    ), {}, 'lost samples', ['20 of 200 samples']),
    (fallen_silent, {}, 'lost samples', []),
    (lambda: with_outputs(twice), {}, 'repeated samples', ['came twice']),
    (lambda: bad_values(nan), {}, 'values', ['20 on plant_output']),
    (late_now_and_then, {}, 'jitter', []),
    (lambda: with_outputs(lambda sent: [m._replace(received_ns=m.stamp_ns - 10**9) for m in sent]),
     {}, 'clock', ['synchronise']),
    (lambda: made.heard_from_driver(delay=5), {}, 'reaction delay',
     ['set control.delay_samples: 5']),
    (lambda: made.heard_from_driver(delay=2, report=True), {}, 'reaction delay',
     ['set control.delay_samples: 2']),
    (lambda: made.heard_from_driver(report=True, limit=3.5),
     {'estimator__use_applied_control': False}, 'applied_control',
     ['estimator.use_applied_control: true']),
    (made.heard_from_driver, {'estimator__use_applied_control': True}, 'applied_control', []),
    (lambda: made.heard_from_driver(sign=-1.0), {}, 'sign and units', ['m would be -1.3']),
    (lambda: made.heard_from_driver(sign=180.0 / np.pi),
     {'estimator__bounds__m': [0.5, 3.0], 'estimator__output_noise_std': 0.1}, 'sign and units',
     ['m would be 74']),
    (lambda: made.heard_from_driver(reach=0.15), {}, 'backlash', ['wider than the gap']),
    (lambda: made.heard_from_driver(rising=True), {}, 'backlash', ['both directions']),
    (lambda: with_controls(None), {}, 'backlash', ['--drive']),
    (lambda: with_controls(0.0), {}, 'backlash', ['--drive']),
    (Heard, {}, 'rate', []),
    (lambda: made.heard_from_driver(samples=30), {}, 'backlash', []),
])
def test_a_fault_of_the_driver_is_the_only_one_told_with_its_figure_and_its_cure(
    heard: Callable[[], Heard], changes: dict[str, object], subject: str, told: list[str],
) -> None:
    found = made.faults(heard(), **changes)
    assert made.subjects(found) == [subject]
    assert all(words in f'{found[0].found} {found[0].cure}' for words in told)


@pytest.mark.parametrize(('heard', 'changes'), [
    ({'delay': 5}, {'control__delay_samples': 5}),
    ({'delay': 2, 'report': True}, {'control__delay_samples': 2}),
    ({'delay': 2, 'report': True}, {'estimator__use_applied_control': True}),
    ({'report': True, 'limit': 3.5}, {'estimator__use_applied_control': 'true'}),
    ({'report': True, 'limit': 3.5}, {'estimator__use_applied_control': 'auto'}),
])
def test_what_the_parameters_announce_is_no_fault(heard, changes):
    assert made.faults(made.heard_from_driver(**heard), **changes) == []


def test_a_timer_that_catches_up_is_not_taken_for_a_relay() -> None:
    # After every twentieth sample the timer was late and makes up for it at once.
    heard = with_outputs(lambda sent: [
        m._replace(stamp_ns=m.stamp_ns - int(0.9 * made.PERIOD_S * 1e9)) if k % 20 == 19 else m
        for k, m in enumerate(sent)])
    found = next(f for f in made.faults(heard) if f.subject == 'repeated samples')
    assert 'right after the one before' in found.found
    assert 'catching up' in found.cure


def test_a_sensor_slower_than_the_driver_is_told() -> None:
    heard = with_outputs(lambda sent: [
        m._replace(value=sent[k - k % 2].value) for k, m in enumerate(sent)])
    assert 'repeated samples' in made.subjects(made.faults(heard, estimator__output_noise_std=0.1))


@pytest.mark.parametrize('use', ['auto', 'true'])
def test_applied_control_that_leaves_samples_out_is_told(use: str) -> None:
    found = made.faults(reports_with_holes(), estimator__use_applied_control=use)
    assert made.subjects(found)[0] == 'applied_control'
    assert 'comes with 75% of the samples' in found[0].found


@pytest.mark.parametrize('ratio', [0.8, 1.2])
def test_a_model_that_is_off_by_a_fifth_fits_and_the_finding_says_how_far(ratio: float) -> None:
    numerator, denominator = made.model(ratio * made.PERIOD_S)  # another natural frequency
    findings = judge(made.GOOD_GRAPH, made.heard_from_driver(), Parameters(made.parameters(
        plant__numerator=numerator, plant__denominator=denominator)))
    assert all_fit(findings), table(findings)
    found = next(f.found for f in findings if f.subject == 'G(z)')
    told, true = TransferFunction(numerator, denominator), TransferFunction(*made.model())
    said = [(float(error) / 100.0, float(frequency)) for error, frequency in
            re.findall(r'([\d.]+)% at ([\d.]+) Hz', found)]
    assert len(said) == 2
    for error, frequency in said:
        z = np.exp([2j * np.pi * frequency * made.PERIOD_S])
        assert error == pytest.approx(abs(true.response(z) / told.response(z) - 1.0)[0], rel=0.1)


@given(
    st.floats(-20.0, 5.0), st.floats(0.1, 30.0), st.floats(0.1, 200.0), st.floats(-3.0, 3.0),
    st.floats(0.01, 1.0) | st.just(np.inf),
)
@example(-15.983699780621828, 29.100769855162365, 103.26211025102096, -2.3048063251753783, np.inf)
def test_a_drive_keeps_its_limits_and_comes_to_rest(low, width, rate, start, acceleration):
    limits = Limits(low, low + width, 0.01 * rate, acceleration)
    start = min(max(start, limits.low), limits.high)
    drive = Drive(limits, 0.01, 2.0, start)
    path = [start, *(drive.step() for _ in range(200))]
    path += islice(drive.to_rest(), 100_000)
    moves = np.abs(np.diff(path))
    assert path[-1] == limits.zero
    assert moves.max() <= limits.move * (1.0 + 1e-9) + 1e-12
    assert np.abs(np.diff(moves)).max() <= acceleration * (1.0 + 1e-9) + 1e-12
    assert min(path) >= limits.low - 1e-12
    assert max(path) <= limits.high + 1e-12


@pytest.mark.parametrize(('limits', 'name'), [
    ({}, 'control.min'), ({'control.min': -1.0}, 'control.max'),
    ({'control.min': -1.0, 'control.max': 1.0}, 'control.rate_max'),
])
def test_drive_without_a_limit_is_refused(limits: dict[str, float], name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        drive_limits(Parameters(limits), None, None)


def test_options_narrow_the_limits_and_never_widen_them() -> None:
    p = Parameters(made.parameters())
    assert drive_limits(p, 2.0, 10.0) == Limits(-2.0, 2.0, 10.0 * made.PERIOD_S)
    widest = Limits(-made.REACH, made.REACH, made.RATE * made.PERIOD_S)
    assert drive_limits(p, 100.0, 1000.0) == widest


def test_similar_topics_are_named() -> None:
    seen = ['/y', '/plant_outputs', '/plant_output', '/motor/plant_output', '/camera/image']
    assert similar_topics('/plant_output', seen) == ('/motor/plant_output', '/plant_outputs')
