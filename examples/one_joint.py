"""Lets one joint of an arm look like a lone actuator, for `check_driver` and `identify --drive`.

    python examples/one_joint.py waist

    robot_joint_states ─► plant_output          joint_commands ◄─ control
    applied_joint_commands ─► applied_control

The driver of the arm holds the other joints where they are. Start no controller of the arm beside.
"""

from __future__ import annotations

import argparse
import signal
from threading import Event

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64


class OneJoint(Node):
    """Passes on what concerns one joint."""

    def __init__(self, joint: str) -> None:
        super().__init__('one_joint')
        self._joint = joint
        self._commands = self.create_publisher(JointState, 'joint_commands', 10)
        for heard, told in (
            ('applied_joint_commands', 'applied_control'), ('robot_joint_states', 'plant_output'),
        ):
            self._pass_on(heard, told)
        self.create_subscription(Float64, 'control', self._command, 1)

    def _pass_on(self, heard: str, told: str) -> None:
        publisher = self.create_publisher(Float64, told, 10)

        def pass_on(message: JointState) -> None:
            if self._joint in message.name:
                position = message.position[message.name.index(self._joint)]
                publisher.publish(Float64(data=position))

        self.create_subscription(JointState, heard, pass_on, qos_profile_sensor_data)

    def _command(self, message: Float64) -> None:
        self._commands.publish(JointState(name=[self._joint], position=[message.data]))


def main() -> None:
    """Run until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('joint')
    options = parser.parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopping = Event()  # an exception could be raised in the middle of reading a message
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    executor = SingleThreadedExecutor()
    executor.add_node(OneJoint(options.joint))
    while not stopping.is_set():
        executor.spin_once(timeout_sec=0.1)  # a signal does not end a longer wait
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
