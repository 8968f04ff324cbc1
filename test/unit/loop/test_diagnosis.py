"""What the controller says is wrong with the loop, from figures alone."""

from dataclasses import replace as replaced
from itertools import product
from math import inf, nan
from typing import Any

import pytest

from backlash_ros.core.estimate import Status
from backlash_ros.core.law import LawReport, OutOfBounds
from backlash_ros.core.loop.diagnosis import (
    ENOUGH_REVERSALS,
    LONGEST_TEXT,
    UNNAMED,
    Finding,
    Learning,
    Level,
    LoopFigures,
    Neighbours,
    Peer,
    TopicFigures,
    causes_of,
    findings_of,
)
from backlash_ros.core.loop.sample_counter import Period, Timing

DRIVER, OTHER = Peer('/driver', 'Float64'), Peer('/other', 'Float64')
WELL = LoopFigures(
    timing=Timing(0.005, intervals_s=(0.005, 0.005, 0.005)),
    around=Neighbours(
        TopicFigures('plant_output', peers=(DRIVER,)),
        TopicFigures('reference', peers=(Peer('/reference', 'Float64'),)),
        TopicFigures('control', peers=(DRIVER,)),
    ), learning=Learning(Status.TRACKING), used=600,
)


def replace(figures: LoopFigures, **changes: Any) -> LoopFigures:
    for part in ('timing', 'around', 'learning'):
        present = getattr(figures, part)
        own = {name: changes.pop(name) for name in present._fields if name in changes}
        changes[part] = present._replace(**own)
    return replaced(figures, **changes)


INCONSISTENT = replace(WELL, status=Status.INCONSISTENT)
LEARNED = Finding(Level.OK, 'learned', 'learned: the estimates agree with the data')
BLAMED = 'plant_output does not follow from v through G(z): check G(z), the sensor, the actuator'


def output_from(*peers: Peer) -> TopicFigures:
    return TopicFigures('plant_output', peers=peers)


def reference_from(*peers: Peer) -> TopicFigures:
    return TopicFigures('reference', peers=peers)


CASES: list[tuple[dict[str, Any], Level, str]] = [
    ({'intervals_s': (0.02, 0.02, 0.02)}, Level.WARN,
     'plant_output comes at 50 Hz, sample_period is 0.005 s (200 Hz): correct one of them'),
    ({'intervals_s': (0.0001, 0.0025, 0.0026)}, Level.WARN, 'plant_output comes at 400 Hz'),
    ({'age_s': 0.05}, Level.WARN,
     'plant_output comes 50 ms after its stamp: set both clocks (chrony, PTP) or shorten the path'),
    ({'age_s': -0.003}, Level.WARN,
     'plant_output comes 3 ms before its stamp: set both clocks (chrony, PTP)'),
    ({'late': 60}, Level.WARN, '10 % of control came too late: relieve the machine'),
    ({'lost': 66}, Level.WARN, '9.91 % of plant_output was lost on its way'),
    ({'lost': 66, 'unsent': 66}, Level.WARN, '9.91 % of plant_output was never sent'),
    ({'rivals': ('/b/controller',)}, Level.ERROR,
     '2 publishers of control, also /b/controller: stop one'),
    ({'output': output_from(DRIVER, OTHER)}, Level.WARN, '2 publishers of plant_output'),
    ({'reference': reference_from(DRIVER, OTHER)}, Level.WARN,
     'reference is published by /driver, /other: stop all but one'),
    ({'output': output_from(Peer('/driver', 'Float32', 'type')), 'status': None, 'used': 0},
     Level.ERROR, 'plant_output is sent as Float32, Float64 is wanted: change /driver'),
    ({'output': output_from(Peer('/driver', 'Float64', 'reliability')), 'status': None, 'used': 0},
     Level.ERROR, 'plant_output is sent best effort, which does not arrive: set io.best_effort'),
    ({'reference': reference_from(Peer('/r', 'Float64', 'reliability')), 'status': None},
     Level.ERROR, 'reference is sent best effort, which does not arrive: publish it reliable'),
    ({'reference': reference_from(Peer('/r', 'Float64', 'qos')), 'status': None},
     Level.ERROR, 'reference of /r does not arrive: its QoS does not fit'),
    ({'output': output_from(Peer('/driver', 'Float64', 'qos')), 'status': None, 'used': 0},
     Level.ERROR, 'plant_output of /driver does not arrive: its QoS does not fit'),
    ({'reference': reference_from(Peer('/r', 'Float32', 'type')), 'status': None},
     Level.ERROR, 'reference is sent as Float32, Float64 is wanted: change /r'),
    ({'control': TopicFigures('control', peers=(Peer('/driver', 'Float32', 'type'),))},
     Level.ERROR, 'control is a Float64, but /driver wants Float32'),
    ({'control': TopicFigures('control', peers=(Peer('/driver', 'Float64', 'qos'),))},
     Level.ERROR, 'control does not reach /driver: its QoS does not fit'),
    ({'bad_outputs': 600, 'used': 0}, Level.ERROR,
     '100 % of plant_output is no number within ±1e+12: check the sensor'),
    ({'bad_outputs': 60}, Level.WARN, '9.09 % of plant_output is no number within ±1e+12'),
    ({'bad_references': 3, 'reference_silent_s': inf, 'status': None, 'used': 0,
      'without_reference': 600}, Level.WARN, '3 reference messages lately were no numbers'),
    ({'silent_s': 0.5}, Level.WARN, 'no plant_output for 0.5 s: is the driver running? '
     'on_timeout: hold'),
    ({'status': None, 'used': 0, 'output': output_from()}, Level.WARN,
     'waiting for plant_output: nobody publishes it, start the driver'),
    ({'status': None, 'used': 0}, Level.WARN,
     'waiting for plant_output: /driver is there but sends none'),
    ({'status': None, 'used': 0, 'without_reference': 600, 'reference_silent_s': inf,
      'reference': reference_from()}, Level.WARN,
     'waiting for reference: nobody publishes it, start one'),
    ({'reference_silent_s': 1.0}, Level.WARN, 'no reference for more than 1 s'),
    ({'control': TopicFigures('control')}, Level.WARN, 'nobody listens to control'),
    ({'still': 200, 'v_swing': 2.0, 'gap': 0.5}, Level.WARN,
     'plant_output stands still while v swings over 2 (4 gaps): check sensor, actuator, its'),
    ({'still': 1000, 'v_swing': 16.0}, Level.WARN,
     'plant_output stands still while v swings over 16: check sensor, actuator, its controller'),
    ({'wraps': 1}, Level.WARN, 'plant_output jumps by 2 pi: it is an angle that wraps'),
    ({'repeats_stamps': True}, Level.WARN, 'plant_output repeats its stamps'),
    ({'status': Status.NOT_EXCITED, 'limited': 400}, Level.WARN,
     'v is limited in 66.7 % of the samples: widen control.min'),
    ({'unreported': 60}, Level.WARN, '10 % of the samples came without applied_control'),
    ({'dead_workers': 1}, Level.WARN, 'the process that makes the fits died lately'),
    ({'failed_fits': 2}, Level.WARN, 'the newest fits failed, so the estimates may be old'),
    ({'law': LawReport(overdue=2500)}, Level.WARN, 'the fits are 12 s behind; v is not affected'),
    ({'dead_workers': 3}, Level.WARN, 'the process that makes the fits died 3 times lately'),
]
IDS = [text[:40] for *_, text in CASES]


def first(figures: LoopFigures) -> Finding:
    return findings_of(figures)[0]


def test_every_status_has_words_of_its_own() -> None:
    texts = [first(replace(WELL, status=status)).text for status in (None, *Status)]
    assert len(set(texts)) == len(Status) + 1


def test_every_cause_of_the_table_is_tried_here() -> None:
    tried = {first(replace(WELL, **changes)).kind for changes, *_ in CASES}
    unfit = {
        'output type', 'output reliability', 'output qos', 'reference type',
        'reference reliability', 'reference qos', 'control type', 'control qos'}
    assert tried == {kind for kind, *_ in causes_of(WELL)} | unfit


@pytest.mark.parametrize(('changes', 'level', 'text'), CASES, ids=IDS)
def test_each_cause_is_named_with_its_figure_and_its_cure(changes, level, text):
    finding = first(replace(WELL, **changes))
    assert finding.text.startswith(text)
    assert finding.level == level


def test_estimates_of_before_that_hold_are_not_said_to_move() -> None:
    acquiring = replace(WELL, status=Status.ACQUIRING)
    assert first(acquiring).kind == 'acquiring'
    assert first(replace(acquiring, law=LawReport(unconfirmed=True))).kind == 'known'
    assert first(replace(WELL, law=LawReport(unconfirmed=True))) == LEARNED
    assert first(replace(acquiring, law=LawReport(unconfirmed=True), adapting=False)).kind == \
        'adaptation off'


@pytest.mark.parametrize(('reversals', 'kind'), [
    (nan, 'acquiring'), (0, 'one way'), (1, 'acquiring'), (ENOUGH_REVERSALS, 'undecided')])
def test_motion_that_cannot_tell_the_gap_is_named(reversals, kind):
    law = LawReport(reversals=reversals)
    finding = first(replace(WELL, status=Status.ACQUIRING, law=law))
    assert finding.kind == kind
    assert len(finding.text) <= LONGEST_TEXT
    assert first(replace(WELL, law=law)) == LEARNED


@pytest.mark.parametrize(('changes', 'text'), [
    ({'law': LawReport(unexplained=0.234)},
     '23.4 % of m*gap of the motion of u fits no G and no backlash: check G(z), load, sensor'),
    ({'law': LawReport(coasts=True, unexplained=0.234)},
     'the load coasts in the gap (23 % of m*gap): brake it, or move more slowly'),
    ({'law': LawReport(wrong_sign=True, unexplained=0.3)},
     'plant_output moves against v: reverse it, or the sign of plant.numerator'),
    # What noise leaves, or what has no gap to be compared with, is no reason.
    ({'law': LawReport(unexplained=0.01)}, BLAMED),
    ({'law': LawReport(unexplained=inf)}, BLAMED),
])
def test_a_contradiction_is_named_by_what_the_fit_has_found(changes, text):
    found = first(replace(INCONSISTENT, **changes))
    assert found == Finding(Level.ERROR, 'model', text)
    assert len(text) <= LONGEST_TEXT
    assert findings_of(replace(WELL, **changes)) == [LEARNED]


@pytest.mark.parametrize(('forbidden', 'text'), [
    (OutOfBounds('c_r', -9.65432, (-3.0, 3.0)), 'c_r is -9.654, beyond estimator.bounds.c_r '
     '[-3, 3]: widen it, or correct the zero of y'),
    (OutOfBounds('m', 0.3, (0.05, 0.2)), 'm is 0.3, beyond estimator.bounds.m [0.05, 0.2]: widen '
     'it'),
])
def test_a_bound_that_forbids_an_estimate_is_a_warning_with_what_was_found(forbidden, text):
    figures = replace(WELL, status=Status.ACQUIRING, law=LawReport(forbidden=forbidden))
    assert findings_of(figures) == [Finding(Level.WARN, 'bound', text)]


@pytest.mark.parametrize(('late', 'kinds'), [(20, ['model', 'late']), (90, ['late', 'held'])])
def test_the_model_is_not_blamed_where_a_tenth_of_the_commands_is_late(late, kinds) -> None:
    figures = replace(INCONSISTENT, late=late, inconsistent_s=60.0)
    assert [finding.kind for finding in findings_of(figures)] == kinds


def test_what_the_fit_has_found_goes_before_what_may_be_missing() -> None:
    for known in ({'law': LawReport(wrong_sign=True)}, {'law': LawReport(unexplained=0.2)}):
        figures = replace(INCONSISTENT, unreported=30, inconsistent_s=10.0, **known)
        assert [finding.kind for finding in findings_of(figures)] == ['model', 'unreported']


@pytest.mark.parametrize('changes', [
    {'limited': 400}, {'age_s': 0.05}, {'late': 60}, {'lost': 66}, {'unreported': 60},
    {'period': Period(0.00506, 1e-7, 0.005)}, {'intervals_s': (0.02, 0.02, 0.02)},
])
def test_a_wrong_sign_is_named_before_what_it_or_a_busy_machine_leads_to(changes):
    found = findings_of(replace(INCONSISTENT, law=LawReport(wrong_sign=True), **changes))
    assert (found[0].kind, len(found)) == ('model', 2)


def test_a_rival_whose_name_is_not_known_yet_is_no_line_of_the_log_at_once() -> None:
    for standing_down in (False, True):
        unnamed = first(replace(WELL, rivals=(UNNAMED,), standing_down=standing_down))
        assert unnamed.lasting
        assert unnamed.level == Level.ERROR
        assert not first(replace(WELL, rivals=('/b',), standing_down=standing_down)).lasting


@pytest.mark.parametrize('changes', [
    {'still': 200, 'v_swing': 2.0, 'gap': 1.0}, {'limited': 400}, {'late': 3},
    {'output': output_from(DRIVER, OTHER)},
])
def test_an_estimate_that_does_not_fit_stays_an_error_beside_other_causes(changes):
    found = findings_of(replace(INCONSISTENT, **changes))
    assert max(finding.level for finding in found) == Level.ERROR


@pytest.mark.parametrize(('hz', 'std', 'said'), [
    (188.8, 1e-6, 'plant_output comes at 188.8 Hz, sample_period is 0.005 s (200 Hz): correct one'),
    (198.9, 1e-7, 'plant_output comes at 198.9 Hz'), (199.2, 1e-6, 'learned'),
    (198.0, 2e-5, 'learned'),  # nobody knows
])
def test_a_rate_that_is_a_little_off_is_named_first(hz: float, std: float, said: str) -> None:
    f = replace(WELL, period=Period(1.0 / hz, std, 1.0 / hz), late=30, lost=30)
    assert findings_of(f)[0].text.startswith(said) or 'learned' in said
    assert ('comes at' in findings_of(f)[0].text) == ('learned' not in said)


def test_a_driver_that_pauses_now_and_then_is_not_asked_for_another_rate() -> None:
    (found, *_) = findings_of(replace(WELL, period=Period(0.00506, 1e-7, 0.005)))
    assert found.text == \
        'plant_output comes at 197.6 Hz, sample_period is 0.005 s (200 Hz): is the driver held up?'


@pytest.mark.parametrize('changes', [
    {'intervals_s': (0.005, 0.0072, 0.01)},  # a third is lost
    {'intervals_s': (0.005, 0.008, 0.02)},  # the driver stands still now and then
    {'intervals_s': (0.0001, 0.0025, 0.005)},  # each is sent twice
    {'intervals_s': (0.0053, 0.0054, 0.0055)}, {'intervals_s': (nan, nan, nan)},
    {'still': 2000, 'v_swing': 0.9, 'gap': 1.0}, {'still': 5, 'v_swing': 3.0, 'gap': 1.0},
    {'still': 500, 'v_swing': 3.0},  # nobody knows the gap yet
])
def test_losses_jitter_and_a_sensor_at_rest_with_v_inside_the_gap_are_no_fault(changes):
    assert first(replace(WELL, **changes)) == LEARNED


@pytest.mark.parametrize(('changes', 'text', 'trouble', 'level'), [
    ({'adapting': False}, 'estimates held by ~/freeze_adaptation',
     {'status': Status.INCONSISTENT}, Level.ERROR),
    ({'given': True}, 'estimates as given', {'late': 60}, Level.WARN),
])
def test_what_is_held_or_given_is_not_called_learned(changes, text, trouble, level):
    assert first(replace(WELL, **changes)).text.startswith(text)
    assert first(replace(WELL, **changes, **trouble)).level == level


def test_long_names_of_topics_and_nodes_leave_the_cure_in_place() -> None:
    node = Peer('/a_rather_long_namespace/of_a_large_robot/my_driver_node', 'Float64MultiArray')
    names = {
        'output': TopicFigures('/robot/left_arm/shoulder_pan/joint_states', 'JointState', (node,)),
        'control': TopicFigures('forward_command_controller/commands', 'Float64MultiArray', (
            node,))}
    late = first(replace(WELL, late=60, **names))
    assert late.text == \
        '10 % of …/commands came too late: relieve the machine or lengthen sample_period'
    held = first(replace(INCONSISTENT, **names)).text
    assert held.startswith('…/joint_states does not follow from v')
    for changes, _, _ in CASES:
        for role in names.keys() - changes.keys():
            for found in findings_of(replace(WELL, **{**changes, role: names[role]})):
                assert not found.text.endswith('…')


def test_no_text_is_cut_off_by_a_terminal() -> None:
    for (a, *_), (b, *_) in product(CASES, CASES):
        for finding in findings_of(replace(INCONSISTENT, **{**a, **b})):
            assert len(finding.text) <= LONGEST_TEXT
