"""io.style: ros2_control, against a stand-in for joint_state_broadcaster and forward controller."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from drivers.paced_driver import NOISE, PacedDriver
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import RosWorld, ros_world
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

from backlash_ros import topics
from backlash_ros.tools import report as report


class StandIn:
    """Speaks the topics of ros2_control in front of a PacedDriver.

    Every state is stamped with the time of the sample and leaves some time later. clock_ns: by how
    much its clock is ahead. stamped: samples that share a stamp. second: another publisher in this
    process, of zeros with the same stamps.
    """

    def __init__(
        self, world: RosWorld, field: str, names: list[str], best_effort: bool, clock_ns: int = 0,
    ) -> None:
        self._clock_ns = clock_ns
        probe = world.probe()
        self.driver = driver = PacedDriver(probe)
        probe.node.create_subscription(
            Float64MultiArray, topics.JOINT_COMMANDS, self._hear, 1000
        )
        qos = QoSProfile(depth=10, reliability=(
            ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        ))
        self.stamped = 1
        self.second: Publisher | None = None
        self._stamp_ns = 0
        self._states = probe.node.create_publisher(JointState, topics.JOINT_STATES, qos)
        self._field, self._names = field, names
        driver.sent = self._send

    def meet(self) -> None:
        """Wait until the controller listens."""
        self.driver.probe.wait_until(
            lambda: self._states.get_subscription_count() > 0
            and self.driver.reference.get_subscription_count() > 0
            and self.driver.probe.node.count_publishers(topics.JOINT_COMMANDS) > 0,
            'the controller',
        )
        self.driver.rest()

    def _hear(self, command: Float64MultiArray) -> None:
        (v,) = command.data
        self.driver.controls.append(Float64(data=v))

    def _send(self, k: int, y: float) -> list[float]:
        if k % self.stamped == 0 or not self._stamp_ns:
            now_ns = self.driver.probe.node.get_clock().now().nanoseconds
            self._stamp_ns = now_ns + self._clock_ns
        message = JointState(header=Header(stamp=Time(
            sec=self._stamp_ns // 10**9, nanosec=self._stamp_ns % 10**9
        )), name=self._names)
        setattr(message, self._field, [0.1 * i for i in range(len(self._names) - 1)] + [y])
        self._states.publish(message)
        if self.second is not None:
            setattr(message, self._field, [0.0] * len(self._names))
            self.second.publish(message)
        return []


@pytest.mark.parametrize(
    ('field', 'names', 'best_effort'),
    [
        ('position', ['axle'], False),
        ('velocity', ['other', 'axle'], False),
        ('effort', ['first', 'second', 'axle'], True),
    ],
)
def test_backlash_is_learned_through_the_messages_of_ros2_control(
    tmp_path: Path, field: str, names: list[str], best_effort: bool,
) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {
            'estimator.output_noise_std': NOISE, 'io.style': 'ros2_control', 'io.field': field,
            'io.joint': names[-1], 'io.best_effort': best_effort,
        })
        stand_in = StandIn(world, field, names, best_effort)
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until_known(0.02)
        driver.check_sanity()
        assert controller.stop() == 0


@pytest.mark.usefixtures('undrawn')
def test_the_loop_through_ros2_control_is_recorded_and_reported(tmp_path: Path) -> None:
    style = {'io.style': 'ros2_control', 'estimator.output_noise_std': NOISE}
    with ros_world(tmp_path) as world:
        controller = world.start('controller', style)
        recorder = world.start('recorder', {
            'io.style': 'ros2_control', 'bag': str(tmp_path / 'bag'), 'wait_for_publishers': True,
        })
        stand_in = StandIn(world, 'position', ['axle'], best_effort=False)
        recorder.wait_for('ready')
        stand_in.meet()
        stand_in.driver.run_until_known(0.02)
        assert controller.stop() == 0
        assert recorder.stop() == 0
        recorded = recorder.wait_for('closed')['messages']
        assert recorded[f'/{topics.JOINT_STATES}'] > 20
        assert recorded[f'/{topics.JOINT_COMMANDS}'] > 20
    assert report.main([str(tmp_path / 'bag'), '--out', str(tmp_path / 'out')]) == 0
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['final']['m'] == pytest.approx(1.3, rel=0.02)


@pytest.mark.parametrize(('clock_ms', 'said'), [(50, 'before its stamp'), (-50, 'after its stamp')])
def test_a_driver_with_another_clock_is_told(tmp_path: Path, clock_ms: int, said: str) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'io.style': 'ros2_control'})
        stand_in = StandIn(world, 'position', ['axle'], False, clock_ns=clock_ms * 10**6)
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until(lambda: driver.says(said), 'a word about the clock')
        assert controller.stop() == 0


def test_a_joint_that_is_not_there_is_told(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'io.style': 'ros2_control', 'io.joint': 'axel'})
        stand_in = StandIn(world, 'position', ['axle'], best_effort=False)
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until(
            lambda: driver.says("no position of joint 'axel' but axle"), 'a word about the joint'
        )
        assert driver.controls == []
        assert controller.stop() == 0


def test_of_two_publishers_with_the_same_stamps_the_first_one_is_used(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {
            'io.style': 'ros2_control', 'estimator.output_noise_std': NOISE,
        })
        stand_in = StandIn(world, 'position', ['axle'], False)
        driver = stand_in.driver
        stand_in.second = driver.probe.publisher(topics.JOINT_STATES, JointState)
        stand_in.meet()
        driver.run_until_known(0.02)
        driver.check_sanity()
        driver.run_until(lambda: driver.says('2 publishers of joint_states'), 'a word about them')
        assert controller.stop() == 0


@pytest.mark.parametrize('stamped', [2, 1_000_000])
def test_a_driver_that_repeats_its_stamps_is_told_and_served(tmp_path: Path, stamped: int) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {
            'io.style': 'ros2_control', 'estimator.output_noise_std': NOISE,
        })
        stand_in = StandIn(world, 'position', ['axle'], False)
        stand_in.stamped = stamped
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until_known(0.02)
        driver.run_until(lambda: driver.says('joint_states repeats its stamps'), 'a word about it')
        assert not driver.says('clock')
        assert controller.stop() == 0
