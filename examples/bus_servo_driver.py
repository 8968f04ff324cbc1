"""Driver of an arm with Dynamixel servos of the X series on one bus (pip install dynamixel-sdk).

    python examples/bus_servo_driver.py --port /dev/ttyUSB0 --joints waist=1 shoulder=2 elbow=3

Every cycle it reads all servos with one packet, and publishes

    applied_joint_commands  sensor_msgs/JointState  where the servos were told to go [rad]
    robot_joint_states      sensor_msgs/JointState  where the joints are [rad], and how fast

A command goes to all servos with one packet as soon as it comes, in one of the forms

    joint_commands                       sensor_msgs/JointState      position by name of the joint
    forward_command_controller/commands  std_msgs/Float64MultiArray  positions as --joints has them

A servo that does not answer is missing in the messages, and is asked again now and then. Servos are
engaged where they stand and go to their commands at --speed at most. Without a command for 20
cycles the arm holds; should this program hang, the watchdogs of the servos stop them. At its end
the torque is switched off: an arm with weight falls.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import time
from collections.abc import Sequence
from threading import Event

import rclpy
from dynamixel_bus import CENTRE, STEP, UNPLUGGED, PatientPort, ServoBus
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

HOLD_AFTER, RETRY_AFTER = 20, 50  # cycles


class BusServoDriver(Node):
    """Tells where the joints are once per period, and moves them as it is told.

    lost: cycles in which not all joints could be read, or that the machine was too busy for.
    """

    def __init__(self, bus: ServoBus, joints: dict[str, int], rate: float, speed: float) -> None:
        super().__init__('bus_servo_driver')
        self._bus, self._joints, self._period_s, self._speed = bus, joints, 1.0 / rate, speed
        self._wanted: dict[int, float] = {}  # [rad]
        self.cycles = self.lost = self._unheard = 0
        self._begin = self._moved = time.monotonic()
        self._said = ''
        self._applied = self.create_publisher(JointState, 'applied_joint_commands', 10)
        self._states = self.create_publisher(JointState, 'robot_joint_states', 10)
        self.create_subscription(JointState, 'joint_commands', lambda message: self._command(
            message.name, message.position), 1)
        self.create_subscription(
            Float64MultiArray, 'forward_command_controller/commands',
            lambda message: self._command(list(joints), message.data), 1)
        self.create_timer(self._period_s, self._cycle)

    def _command(self, names: Sequence[str], positions: Sequence[float]) -> None:
        if len(names) == len(positions):
            self._unheard = 0
            self._wanted.update({
                self._joints[name]: min(max(v, -math.pi), (CENTRE - 1) * STEP)
                for name, v in zip(names, positions, strict=True)
                if name in self._joints and math.isfinite(v)
            })
            with contextlib.suppress(*UNPLUGGED):  # the next cycle notices
                self._move()

    def _cycle(self) -> None:
        before = self.cycles
        self.cycles = max(int((time.monotonic() - self._begin) / self._period_s), before + 1)
        self._unheard += 1
        if self._unheard == HOLD_AFTER:
            self._wanted = {}
        complete = False
        try:
            if self.cycles // RETRY_AFTER > before // RETRY_AFTER or not self._bus.goals:
                self._bus.engage()
            readings = self._bus.read()
            self._publish(readings)
            complete = len(readings) == len(self._joints)
            self._move()
        except UNPLUGGED:
            self._bus.lose()
        finally:  # also where a signal ends the cycle
            self.lost += self.cycles - before - complete
        self._tell()

    def _move(self) -> None:
        """Go on to what is wanted, no faster than allowed."""
        now, goals = time.monotonic(), {}
        most = max(int(self._speed * min(now - self._moved, 2.0 * self._period_s) / STEP), 1)
        for servo in self._wanted.keys() & self._bus.goals.keys():
            way = CENTRE + round(self._wanted[servo] / STEP) - self._bus.goals[servo]
            if way:
                goals[servo] = self._bus.goals[servo] + min(max(way, -most), most)
                self._moved = now
        self._bus.write(goals)

    def _publish(self, readings: dict[int, tuple[float, float]]) -> None:
        names = [name for name, servo in self._joints.items() if servo in readings]
        if names:
            positions, speeds = zip(*(readings[self._joints[name]] for name in names), strict=True)
            goals = [(self._bus.goals[self._joints[name]] - CENTRE) * STEP for name in names]
            states = JointState(name=names, position=positions, velocity=speeds)
            states.header.stamp = self.get_clock().now().to_msg()
            self._applied.publish(JointState(header=states.header, name=names, position=goals))
            self._states.publish(states)

    def _tell(self) -> None:
        """Log which servos are not engaged, once."""
        said = ', '.join(
            f'{name} is silent' if servo not in self._bus.goals else f'{name} has switched off'
            for name, servo in self._joints.items()
            if servo not in self._bus.goals or servo in self._bus.alerts
        )
        if said != self._said:
            self._said = said
            self.get_logger().warning(said or 'all joints are there')


def main() -> None:
    """Run until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--port', required=True)
    parser.add_argument('--joints', required=True, nargs='+', metavar='NAME=ID')
    parser.add_argument('--baud', type=int, default=1_000_000, help='of the servos')
    parser.add_argument('--rate', type=float, default=100.0, help='cycles per second')
    parser.add_argument('--speed', type=float, default=4.0, help='largest one of a joint [rad/s]')
    parser.add_argument('--patience', type=float, default=4.0, help='with a silent servo [ms]')
    options = parser.parse_args()
    joints = {}
    for text in options.joints:
        name, _, servo = text.partition('=')
        if not name or not servo.isdigit() or int(servo) > 252 or int(servo) in joints.values():
            parser.error(f'--joints {text}: NAME=ID, each ID once, from 0 to 252')
        joints[name] = int(servo)
    bus = ServoBus(
        lambda: PatientPort(options.port, options.baud, 1e-3 * options.patience),
        list(joints.values()))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopping = Event()  # an exception could be raised in the middle of reading a message
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    node = BusServoDriver(bus, joints, options.rate, options.speed)
    while not stopping.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    try:
        left = bus.release()
    except UNPLUGGED:
        left = list(joints.values())
    node.get_logger().info(f'{node.cycles} cycles, {node.lost} of them lost; torque is off'
                           + f' but perhaps at {left}' * bool(left))
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
