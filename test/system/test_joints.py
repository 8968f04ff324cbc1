"""Several joints through topic-based hardware and io.style: ros2_control; a lone actuator."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import nan, sin
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from drivers.paced_driver import OF_THE_LOOP, PacedDriver
from places import ROOT
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import DEADLINE_S, NodeProcess, RosWorld, ros_world
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

from backlash_ros import topics
from backlash_ros.tools import report as report

JOINTS = ['waist', 'elbow', 'gripper']
PERIOD = 0.02
ARM: dict[str, object] = {
    'joints': JOINTS, 'io.style': 'joint_state_topic', 'sample_period': PERIOD,
    'estimator.law': 'fixed', 'proportional.f': 0.0, 'control.rate_max': 50.0,
    'control.min': -3.0, 'control.max': 3.0, 'timeout.plant_output': 0.0,
    'estimator.initial.m': 1.0, 'estimator.initial.c_r': 0.02, 'estimator.initial.c_l': -0.03,
    'waist.plant.numerator': [0.5], 'waist.plant.denominator': [1.0, -0.5],
    'elbow.plant.numerator': [0.2], 'elbow.plant.denominator': [1.0, -0.8],
    'elbow.estimator.initial.c_r': 0.05,
}


class Arm:
    """Plays the hardware: sends states one by one, and waits for the commands that answer them."""

    def __init__(self, world: RosWorld, changes: Mapping[str, object]) -> None:
        self.world = world
        self.controller: NodeProcess = world.start('controller', {**ARM, **changes})
        self.probe = world.probe()
        array = changes.get('io.command') == 'array'
        self.commands = self.probe.collect(
            topics.JOINT_COMMANDS if array else topics.JOINT_STATE_COMMANDS,
            Float64MultiArray if array else JointState)
        self.diagnostics = self.probe.collect(topics.DIAGNOSTICS, DiagnosticArray)
        self.signals = self.probe.collect(topics.SIGNALS, Float64MultiArray)
        self._states = self.probe.publisher(topics.ROBOT_STATES, JointState)
        self._references = self.probe.publisher(topics.ROBOT_COMMAND, JointState)
        self.probe.wait_until(
            lambda: self.controller.events('ready') and self._states.get_subscription_count()
            and self._references.get_subscription_count()
            and self.probe.node.count_publishers(topics.SIGNALS), 'the controller')
        self.k = 0

    def refer(self, y_m: Mapping[str, float], velocity: float = 0.5) -> None:
        self._references.publish(JointState(
            name=list(y_m), position=list(y_m.values()), velocity=[velocity] * len(y_m)))
        self.probe.spin(0.02)

    def send(self, y: Mapping[str, float]) -> None:
        stamp_ns = self.stamp_ns(self.k)
        self.k += 1
        self._states.publish(JointState(
            header=Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)),
            name=list(y), position=list(y.values())))

    def answer(self, y: Mapping[str, float]) -> JointState | Float64MultiArray:
        before = len(self.commands)
        self.send(y)
        self.probe.wait_until(lambda: len(self.commands) > before, 'an answer')
        return self.commands[-1]

    @staticmethod
    def stamp_ns(k: int) -> int:
        return round((1000.0 + k * PERIOD) * 1e9)

    def says(self, joint: str, words: str) -> Callable[[], bool]:
        return lambda: any(
            status.name == f'controller: {joint}' and words in text
            for message in self.diagnostics for status in message.status
            for text in (status.message, *(pair.value for pair in status.values)))


@contextmanager
def arm(folder: Path, **changes: object) -> Iterator[Arm]:
    with ros_world(folder) as world:
        made = Arm(world, {name.replace('__', '.'): value for name, value in changes.items()})
        yield made
        assert made.controller.stop() == 0


def reference(k: int) -> dict[str, float]:
    return {joint: 0.4 * sin(0.3 * k + i) for i, joint in enumerate(JOINTS)}


def output(k: int) -> dict[str, float]:
    return {joint: 0.3 * sin(0.3 * k + i) for i, joint in enumerate(JOINTS)}


def test_every_joint_is_answered_by_its_own_loop_in_one_message(tmp_path: Path) -> None:
    with arm(tmp_path) as it:
        answers = []
        for k in range(8):
            it.refer(reference(k))
            answers.append(it.answer(output(k)))
        for answer in answers:
            assert (list(answer.name), list(answer.velocity)) == (JOINTS, [0.5] * 3)
        assert answers[-1].position[2] == pytest.approx(reference(7)['gripper'], abs=1e-12)
        it.probe.wait_until(lambda: len(it.signals) >= 8, 'signals')
        labels = [dimension.label for dimension in it.signals[-1].layout.dim]
        row = dict(zip(labels, it.signals[-1].data, strict=True))
        assert row['elbow.v'] == answers[-1].position[1]
        assert row['waist.y'] == output(7)['waist']
        it.refer({'elbow': 0.2, 'nobody': 7.0, 'waist': 0.1, 'gripper': nan})
        first = it.answer({'stranger': 9.0, 'gripper': 0.0, 'elbow': 0.0, 'waist': 0.0})
        assert list(first.name) == JOINTS
        for _ in range(8):
            answer = it.answer({'elbow': 0.0, 'waist': 0.0})
            assert list(answer.name) == ['waist', 'elbow']
        it.probe.wait_until(
            it.says('gripper', "no position of joint 'gripper' but elbow, waist"), 'who is missing')
        assert list(it.answer({'gripper': 0.0, 'elbow': 0.0, 'waist': 0.0}).name) == JOINTS
        for joint in JOINTS:
            it.probe.wait_until(it.says(joint, ''), f'diagnostics of {joint}')


def test_an_array_has_the_commands_of_all_joints_in_their_order(tmp_path: Path) -> None:
    with arm(tmp_path, io__command='array') as it:
        it.refer(reference(0))
        it.send({'waist': 0.0, 'elbow': 0.0})  # no array before there is a v for all
        for k in range(1, 4):
            it.refer(reference(k))
            answer = it.answer(output(k))
        assert (len(answer.data), len(it.commands)) == (3, 3)
        assert answer.data[2] == pytest.approx(reference(3)['gripper'], abs=1e-12)


def test_outputs_reports_and_commands_of_the_joint_pass_and_no_others(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        probe = world.probe()
        y = probe.collect(topics.PLANT_OUTPUT, Float64)
        applied = probe.collect(topics.APPLIED_CONTROL, Float64)
        commands = probe.collect(topics.JOINT_STATE_COMMANDS, JointState)
        states = probe.publisher(topics.ROBOT_STATES, JointState)
        reports = probe.publisher(topics.APPLIED_JOINT_COMMANDS, JointState)
        control = probe.publisher(topics.CONTROL, Float64)
        node = subprocess.Popen(
            [sys.executable, str(ROOT / 'examples' / 'one_joint.py'), 'elbow'],
            env=world.environment, stdin=subprocess.DEVNULL)
        try:
            probe.wait_until(lambda: all(
                each.get_subscription_count() for each in (states, reports, control)
            ) and probe.node.count_publishers(topics.PLANT_OUTPUT), 'the node')
            def passed() -> bool:
                reports.publish(JointState(name=['waist', 'elbow'], position=[1.0, 0.25]))
                states.publish(JointState(name=['waist'], position=[2.0]))
                states.publish(JointState(name=['elbow', 'waist'], position=[0.5, 3.0]))
                control.publish(Float64(data=0.75))
                return bool(y and applied and commands)
            probe.wait_until(passed, 'all three')
        finally:
            node.terminate()
            code = node.wait(DEADLINE_S)
    assert {message.data for message in y} == {0.5}
    assert {message.data for message in applied} == {0.25}
    assert {(*message.name, *message.position) for message in commands} == {('elbow', 0.75)}
    assert code == 0


class StandIn:
    """Speaks the topics of ros2_control in front of a PacedDriver, best effort.

    Every state is stamped with the time of the sample and leaves some time later. names: of the
    joints, the last of which is meant. second: another publisher in
    this process, of zeros with the same stamps.
    """

    def __init__(self, world: RosWorld, field: str, names: list[str]) -> None:
        probe = world.probe()
        self.driver = driver = PacedDriver(probe)
        probe.node.create_subscription(Float64MultiArray, topics.JOINT_COMMANDS, self._hear, 1000)
        self.qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.second: Publisher | None = None
        self._states = probe.node.create_publisher(JointState, topics.JOINT_STATES, self.qos)
        self._field, self.names = field, names
        driver.sent = self._send

    def meet(self) -> None:
        self.driver.probe.wait_until(
            lambda: self._states.get_subscription_count() > 0
            and self.driver.reference.get_subscription_count() > 0
            and self.driver.probe.node.count_publishers(topics.JOINT_COMMANDS) > 0,
            'the controller')
        self.driver.rest()

    def _hear(self, command: Float64MultiArray) -> None:
        (v,) = command.data
        self.driver.controls.append(Float64(data=v))

    def _send(self, k: int, y: float) -> list[float]:
        now_ns = self.driver.probe.node.get_clock().now().nanoseconds
        message = JointState(header=Header(stamp=Time(
            sec=now_ns // 10**9, nanosec=now_ns % 10**9
        )), name=self.names)
        setattr(message, self._field, [0.1 * i for i in range(len(self.names) - 1)] + [y])
        self._states.publish(message)
        if self.second is not None:
            setattr(message, self._field, [0.0] * len(self.names))
            self.second.publish(message)
        return []


@pytest.mark.usefixtures('undrawn')
def test_the_loop_through_ros2_control_is_learned_recorded_and_reported(tmp_path: Path) -> None:
    style: dict[str, object] = {
        'io.style': 'ros2_control', 'io.field': 'velocity', 'io.joint': 'axle',
        'io.best_effort': True, **OF_THE_LOOP}
    with ros_world(tmp_path) as world:
        controller = world.start('controller', style)
        recorder = world.start('recorder', {
            'io.style': 'ros2_control', 'io.best_effort': True, 'bag': str(tmp_path / 'bag'),
            'wait_for_publishers': True})
        stand_in = StandIn(world, 'velocity', ['other', 'axel'])
        recorder.wait_for('ready')
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until(
            lambda: driver.says("no velocity of joint 'axle' but other, axel"),
            'a word about the joint')
        assert driver.controls == []
        stand_in.names = ['other', 'axle']
        driver.run_until_known(0.02)
        driver.check_sanity()
        stand_in.second = driver.probe.node.create_publisher(
            JointState, topics.JOINT_STATES, stand_in.qos)
        driver.run_until(lambda: driver.says('2 publishers of joint_states'), 'a word about them')
        driver.run(50)
        driver.run_until_known(0.02)
        assert (controller.stop(), recorder.stop()) == (0, 0)
        recorded = recorder.wait_for('closed')['messages']
        assert recorded[f'/{topics.JOINT_STATES}'] > 20
        assert recorded[f'/{topics.JOINT_COMMANDS}'] > 20
    assert report.main([str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]) == 0
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['final']['m'] == pytest.approx(1.3, rel=0.02)
