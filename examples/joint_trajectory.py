"""A trajectory for an arm, through the topics of joint_state_topic_hardware_interface.

    python examples/joint_trajectory.py waist shoulder elbow --duration 30

Stands in for ros2_control, a joint_trajectory_controller with that package's JointStateTopicSystem
below it, where there is no ROS 2 installation to run the real ones: publishes the commands of all
joints on robot_joint_command and listens to robot_joint_states, as the plugin does with these names
given as joint_commands_topic and joint_states_topic. All joints swing about where they stand, each
in a phase of its own.
"""

from __future__ import annotations

import argparse
import math
import signal
import time
from collections.abc import Sequence
from threading import Event

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState


class TopicSystem:
    """Position interfaces of the plugin: read and write of its versions 0.2 to 1.1.

    (https://github.com/ros-controls/topic_based_hardware_interfaces). states, commands: by joint
    [rad], nan until a message or a controller has set them. threshold:
    trigger_joint_command_threshold.
    """

    def __init__(self, joints: Sequence[str], threshold: float = 1e-5) -> None:
        self.states = dict.fromkeys(joints, math.nan)
        self.commands = dict.fromkeys(joints, math.nan)
        self._threshold = threshold

    def read(self, message: JointState) -> None:
        """Take in the newest message: joints by name, no others, nothing that is not finite."""
        for name, position in zip(message.name, message.position, strict=False):
            if name in self.states and math.isfinite(position):
                self.states[name] = position

    def write(self) -> JointState | None:
        """Return what is published now; nothing where all joints are where they belong.

        Not where the commands stand still: play and friction keep the states away from them, so
        that an arm at rest is commanded on and on. Before a controller has set the commands, and
        before the first state, they are published as nan.
        """
        difference = sum(abs(self.states[name] - v) for name, v in self.commands.items())
        if difference <= self._threshold:  # never where it is nan
            return None
        return JointState(name=list(self.commands), position=list(self.commands.values()))


class JointTrajectory(Node):
    """Holds the joints where the first message finds them, then lets them swing [rad, s]."""

    def __init__(
        self, joints: Sequence[str], amplitude: float, period: float, rate: float,
    ) -> None:
        super().__init__('joint_trajectory')
        self.system = TopicSystem(joints)
        self._amplitude, self._period = amplitude, period
        self._begin, self._middle = math.nan, self.system.states
        self._commands = self.create_publisher(
            JointState, 'robot_joint_command', QoSProfile(depth=1)
        )
        self.create_subscription(
            JointState, 'robot_joint_states', self.system.read, qos_profile_sensor_data
        )
        self.create_timer(1.0 / rate, self._update)

    def _update(self) -> None:
        system = self.system
        if not math.isfinite(self._begin) and all(map(math.isfinite, system.states.values())):
            self._begin, self._middle = time.monotonic(), dict(system.states)
        system.commands = {
            name: self._middle[name] + swing(
                time.monotonic() - self._begin, i, self._amplitude, self._period
            ) for i, name in enumerate(system.commands)
        }
        message = system.write()
        if message is not None:
            message.header.stamp = self.get_clock().now().to_msg()
            self._commands.publish(message)


def swing(t: float, joint: int, amplitude: float, period: float) -> float:
    """Where joint number joint is at t [s], beginning at 0 and at rest; nan for nan."""
    growing = 0.5 - 0.5 * math.cos(math.pi * min(t / period, 1.0)) if t == t else t
    return amplitude * growing * math.sin(2.0 * math.pi * t / period + 0.9 * joint)


def main() -> None:
    """Run for the duration, or until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('joints', nargs='+')
    parser.add_argument('--amplitude', type=float, default=0.2, help='[rad]')
    parser.add_argument('--period', type=float, default=8.0, help='of a swing [s]')
    parser.add_argument('--rate', type=float, default=100.0, help='commands per second')
    parser.add_argument('--duration', type=float, default=math.inf, help='[s]')
    options = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopping = Event()  # an exception could be raised in the middle of reading a message
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    node = JointTrajectory(options.joints, options.amplitude, options.period, options.rate)
    end = time.monotonic() + options.duration
    while time.monotonic() < end and not stopping.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
