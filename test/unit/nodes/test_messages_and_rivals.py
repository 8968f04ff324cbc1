"""Parts of the nodes on their own: profiles, numbers as bytes, sections, plots, precedence."""

import struct
from contextlib import closing
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.serialization import deserialize_message, serialize_message
from ros_processes import Probe
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core import Estimate, Parameters, Status
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.middleware import PROFILE, prefer_loopback
from backlash_ros.nodes.control.publishing import labelled
from backlash_ros.nodes.control.rivals import ENDPOINT, SINCE, CommandLock, Rival, Rivals
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.process import unreached
from backlash_ros.tools.bringup.supervisor import free_domain

HERE = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def chosen(environment: dict[str, str]) -> str | None:
    prefer_loopback(environment)
    return environment.get('FASTRTPS_DEFAULT_PROFILES_FILE')


@pytest.mark.parametrize(('environment', 'profile'), [
    (HERE, PROFILE), ({**HERE, 'ROS_STATIC_PEERS': '192.168.0.2'}, PROFILE.with_stem('network')),
    ({}, None), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, None),
])
def test_a_profile_follows_from_who_is_to_be_met(environment, profile) -> None:
    assert chosen({**environment}) == (profile and str(profile))
    assert profile is None or profile.is_file()


def test_a_profile_of_the_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen({**HERE, 'FASTRTPS_DEFAULT_PROFILES_FILE': 'own.xml'}) == 'own.xml'
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').touch()
    assert chosen({**HERE}) is None


@pytest.mark.parametrize('number', [0.0, -1.5, 1e-300, 12.345678901234567, inf, -inf, nan])
def test_a_number_goes_out_and_comes_in_as_a_float64(number: float) -> None:
    assert repr(deserialize_message(messages.message_with(number), Float64).data) == repr(number)
    assert repr(messages.numbers_of(serialize_message(Float64(data=number)))) == repr((number,))
    of_highest_byte_first = b'\x00\x00\x00\x00' + struct.pack('>d', number)
    assert repr(messages.numbers_of(of_highest_byte_first)) == repr((number,))


def test_an_error_is_told_to_who_started_the_node(monkeypatch):
    told = []
    monkeypatch.setattr(messages, 'emit', lambda event, **fields: told.append((event, fields)))
    with free_domain() as domain, closing(Probe(domain)) as probe:
        publisher = messages.DiagnosticsPublisher(probe.node, '', 'waist')
        for level in messages.Level:
            publisher.publish(messages.Finding(level, 'rest', 'it stands still'), {})
    assert told == [('complaint', {'text': 'waist: it stands still'})]


JOINTS = (
    messages.JointMessage(
        5_000_000_006, ('a', 'wrist_1', 'elbow'), (1.0, inf, -2.5), (), (0.1, 0.2, 0.3)),
    messages.JointMessage(7, ('a', 'wrist_1', 'elbow'), (-1.0, 2.0), (3.0,)),
    messages.JointMessage(8, ('a', 'wrist_1', 'eight'), (4.0,)),
    messages.JointMessage(9, ('one',), (), (0.5,)), messages.JointMessage(10))


def test_joints_go_out_as_a_joint_state_and_come_in_as_one() -> None:
    reader = messages.JointReader()
    for content in JOINTS:
        state = deserialize_message(messages.joint_message(content), JointState)
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == content.stamp_ns
        for field in content._fields[1:]:
            assert tuple(getattr(state, field)) == getattr(content, field)
        for frame in ('', 'base', 'world'):
            state.header.frame_id = frame
            assert reader.read(serialize_message(state)) == content


def test_joints_of_a_sender_whose_highest_byte_comes_first_are_understood() -> None:
    message = struct.pack('>4siII2s2xII2s2xIdI', bytes(4), 1, 2, 2, b'f', 1, 2, b'j', 1, 0.5, 0)
    content = messages.JointMessage(1_000_000_002, ('j',), (0.5,))
    assert messages.JointReader().read(message + bytes(4)) == content


@pytest.mark.parametrize(('sections', 'full_name', 'reached'), [
    (['/**', '/plant'], '/plant', True), (['/**/plant'], '/plant', True),
    (['/**/plant'], '/a/b/plant', True), (['/*/plant'], '/a/plant', True),
    (['/pan/plant', '/tilt/plant'], '/pan/plant', True), (['/tilt/**'], '/pan/plant', True),
    (['/**', '/tilt/plant'], '/pan/plant', True), (['/**', '/controller'], '/plant', True),
    (['/plant', '/**'], '/arm/plant', False), (['/arm/plant'], '/plant', False),
    (['/plant'], '/left_plant', False), (['/plnt', '/**'], '/plant', False),
])
def test_sections_that_do_not_reach_their_node_are_named(sections, full_name, reached, tmp_path):
    file = tmp_path / 'parameters.yaml'
    file.write_text(yaml.safe_dump({name: {'ros__parameters': {'seed': 1}} for name in sections}))
    said = unreached(str(file), 'plant', full_name)
    assert said == '' if reached else f'{sections[0].strip("/")} is not for {full_name}' in said


def test_a_sample_has_a_value_of_every_label_and_bands_of_two_deviations() -> None:
    counter = SampleCounter(Parameters().sample_period)
    loop = ControlLoop(Parameters(), Driver(lambda: 0), None, counter)
    loop.take_reference(1.0)
    output = Output(0.5, 0, 0, 0, 0)
    made = loop.answer(output)
    assert made is not None
    loop.note_answer(made, output)
    e = Estimate(1.3, 3.0, -2.0, 0.2, 0.05, 0.1, 0.3, Status.TRACKING)
    values = labelled(loop, made._replace(estimate=e))
    assert {*topics.SIGNAL_LABELS, *topics.ESTIMATE_LABELS, *topics.WATCH_LABELS} == set(values)
    assert (values['m'], values['c_r'], values['c_l'], values['gap']) == (1.3, 3.0, -2.0, 5.0)
    assert (values['m_low'], values['c_l_high']) == pytest.approx((1.2, -1.4))
    assert (values['y_m'], values['y'], values['v'], values['sample']) == (1.0, 0.5, made.v, 0.0)


def rivals_of(own: str = 'b', active_at: float = 10.0, since_ns: int = 100) -> Rivals:
    rivals = Rivals(own, settled_at=5.0)
    rivals.begin(since_ns, active_at)
    return rivals


def claim(identity: str, since_ns: int) -> dict[str, Any]:
    return {ENDPOINT: identity, SINCE: str(since_ns)}


@pytest.mark.parametrize(('identity', 'since_ns', 'was_first'), [
    ('x', 99, True), ('x', 101, False), ('a', 100, True), ('c', 100, False),
])
def test_the_time_of_activation_decides_and_the_identity_where_it_is_equal(
    identity: str, since_ns: int, was_first: bool,
) -> None:
    rivals = rivals_of()
    rivals.hear(claim(identity, since_ns), 10.0)
    rivals.among({identity: '/other'}, 10.0)
    rivals.hear(claim(identity, since_ns), 10.5)
    assert rivals.among({identity: '/other'}, 11.0) == (Rival('/other', was_first),)


def test_without_a_word_presence_at_activation_decides() -> None:
    rivals = rivals_of(active_at=10.0)
    rivals.among({'x': '/early'}, 9.0)
    found = rivals.among({'x': '/early', 'y': '/late'}, 11.0)
    assert found == (Rival('/early', True), Rival('/late', False))


def test_a_controller_that_says_nothing_any_more_is_gone_though_discovery_still_has_it() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 50), 10.0)
    assert rivals.among({'x': '/other'}, 10.0 + 0.9 * messages.SILENT_S) == (Rival('/other', True),)
    assert rivals.among({'x': '/other'}, 10.0 + 1.1 * messages.SILENT_S) == ()


def test_who_is_inactive_has_no_rivals_and_is_none() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 0), 10.0)
    assert rivals.among({'x': '/other'}, 10.1) == ()
    rivals.hear(claim('x', 50), 10.2)
    assert rivals.among({'x': '/other'}, 10.3) == (Rival('/other', True),)
    rivals.begin(0, 10.35)
    assert rivals.among({'x': '/other'}, 10.4) == ()


def test_one_of_a_machine_has_the_lock_of_a_topic_until_it_lets_go_or_ends() -> None:
    first, second = (CommandLock(0, '/control of a test') for _ in range(2))
    assert [first.take(), second.take(), first.take()] == [True, False, True]
    assert CommandLock(1, '/control of a test').take()
    assert CommandLock(0, '/other').take()
    first.release()
    assert [second.take(), first.take()] == [True, False]
    second.release()
