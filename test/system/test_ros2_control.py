"""io.style: ros2_control, against a stand-in for joint_state_broadcaster and forward controller."""

import json
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from drivers.paced_driver import OF_THE_LOOP, PacedDriver
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import RosWorld, ros_world
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header

from backlash_ros import topics
from backlash_ros.tools import report as report


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
            'the controller',
        )
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
        'io.best_effort': True, **OF_THE_LOOP,
    }
    with ros_world(tmp_path) as world:
        controller = world.start('controller', style)
        recorder = world.start('recorder', {
            'io.style': 'ros2_control', 'io.best_effort': True, 'bag': str(tmp_path / 'bag'),
            'wait_for_publishers': True,
        })
        stand_in = StandIn(world, 'velocity', ['other', 'axel'])
        recorder.wait_for('ready')
        stand_in.meet()
        driver = stand_in.driver
        driver.run_until(
            lambda: driver.says("no velocity of joint 'axle' but other, axel"),
            'a word about the joint',
        )
        assert driver.controls == []
        stand_in.names = ['other', 'axle']
        driver.run_until_known(0.02)
        driver.check_sanity()
        stand_in.second = driver.probe.node.create_publisher(
            JointState, topics.JOINT_STATES, stand_in.qos
        )
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
