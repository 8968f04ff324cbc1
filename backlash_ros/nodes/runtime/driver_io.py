"""How y comes from the driver and v goes to it: plain numbers, or the messages of ros2_control."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.core.parameters import Parameters
from backlash_ros.nodes.runtime.messages import DEPTH
from backlash_ros.nodes.runtime.number_message import message_with, number_of
from backlash_ros.nodes.runtime.spin import ProcessNode


class DriverTopics(NamedTuple):
    """Where y comes from and v goes to."""

    output: str
    output_type: type[Any]
    control: str
    control_type: type[Any]


STYLES = {
    'native': DriverTopics(topics.PLANT_OUTPUT, Float64, topics.CONTROL, Float64),
    'ros2_control': DriverTopics(
        topics.JOINT_STATES, JointState, topics.JOINT_COMMANDS, Float64MultiArray
    ),
}


def output_qos(p: Parameters, depth: int) -> QoSProfile:
    """How y is listened to."""
    best_effort = p.get_bool('io.best_effort')
    return QoSProfile(depth=depth, reliability=(
        ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    ))


def message_with_one(v: float) -> Float64MultiArray:
    """A message with this number as the only one of several."""
    return Float64MultiArray(data=array('d', (v,)))


class DriverIo:
    """What a node says to the driver and hears from it, in the messages that io.style names.

    skipped: messages without the joint. seen: the joints of the newest one of them.
    repeats_stamps: whether the driver has sent a stamp twice; since then the time of sending
    counts. simulated_time: whether stamps are those of /clock.
    """

    def __init__(self, node: ProcessNode, p: Parameters) -> None:
        self.skipped, self.seen = 0, ''
        self.repeats_stamps = False
        self._header_ns = self._number = 0  # of the newest message with the joint
        self._node, self._p = node, p
        self.topics = STYLES[p.get_str('io.style')]
        self._joint, self._field = p.get_str('io.joint'), p.get_str('io.field')
        # On simulated time the stamps of the middleware, which are real time, say nothing.
        self.simulated_time = bool(node.get_parameter('use_sim_time').value)
        self._publisher: Publisher | None = None
        several = self.topics.control_type is Float64MultiArray
        self._message_with = message_with_one if several else message_with

    @property
    def publisher(self) -> Publisher:
        """That of v, once it is advertised."""
        assert self._publisher is not None
        return self._publisher

    @property
    def listeners(self) -> int:
        """How many subscribers v has."""
        return 0 if self._publisher is None else self._publisher.get_subscription_count()

    @property
    def is_simulated(self) -> bool:
        """Whether y comes from the plant of this package: no other one tells the truth."""
        return self._node.count_publishers(topics.TRUTH) > 0

    def now_ns(self) -> int:
        """Time on the clock of the stamps."""
        # time.time_ns() is the system clock of ROS, without the detour.
        return self._node.get_clock().now().nanoseconds if self.simulated_time \
            else time.time_ns()

    def stamp_ns(self, info: dict[str, Any]) -> int:
        """When a message left, on the clock of the stamps."""
        return self.now_ns() if self.simulated_time else int(info['source_timestamp'])

    def listen(self, hear: Callable[[Output], None], depth: int) -> Subscription:
        """Call hear with every y."""
        def hear_number(message: bytes, info: dict[str, Any]) -> None:
            sent_ns = info['source_timestamp']
            stamp_ns = self.now_ns() if self.simulated_time else sent_ns
            hear(Output(
                number_of(message), stamp_ns, sent_ns, info['received_timestamp'],
                info['publication_sequence_number'],
            ))

        def hear_joint(message: JointState, info: dict[str, Any]) -> None:
            values = getattr(message, self._field)
            row = self._row(message.name, len(values))
            if row < 0:
                self.skipped, self.seen = self.skipped + 1, ', '.join(message.name)
                return
            stamp, number = message.header.stamp, info['publication_sequence_number']
            stamp_ns = self._header_stamp_ns(stamp.sec * 10**9 + stamp.nanosec, number)
            # Drivers that leave the header empty are known by the stamp of the middleware.
            hear(Output(
                values[row], stamp_ns or self.stamp_ns(info), info['source_timestamp'],
                info['received_timestamp'], number, numbered=False,
            ))

        of_joints = self.topics.output_type is JointState
        return self._node.listen(
            self.topics.output_type, self.topics.output, hear_joint if of_joints else hear_number,
            output_qos(self._p, depth), raw=not of_joints,
        )

    def advertise(self) -> Publisher:
        """Make the publisher of v."""
        to = self.topics
        publisher: Publisher = self._node.create_publisher(to.control_type, to.control, DEPTH)
        self._publisher = publisher
        return publisher

    def listen_to_commands(self, hear: Callable[[float], None]) -> Subscription:
        """Call hear with every v that anybody sends to the driver."""
        def hear_number(message: Float64) -> None:
            hear(message.data)

        def hear_numbers(message: Float64MultiArray) -> None:
            if len(message.data) == 1:
                hear(message.data[0])

        several = self.topics.control_type is Float64MultiArray
        return self._node.create_subscription(
            self.topics.control_type, self.topics.control,
            hear_numbers if several else hear_number, 1,
        )

    def publish(self, v: float) -> None:
        """Send v to the driver."""
        assert self._publisher is not None
        self._publisher.publish(self._message_with(v))

    def wait_until_received(self, timeout_s: float) -> None:
        """Wait until the driver has confirmed the newest v, or the timeout is over."""
        self.publisher.wait_for_all_acked(Duration(nanoseconds=int(timeout_s * 1e9)))

    def _header_stamp_ns(self, stamp_ns: int, number: int) -> int:
        """The stamp in the header of a message with this number; 0 where it tells no time."""
        repeated = stamp_ns == self._header_ns != 0 and number == self._number + 1
        if repeated and not self.repeats_stamps:
            # Two publishers with the same stamps are told apart by their numbers, mostly.
            self.repeats_stamps = self._node.count_publishers(self.topics.output) == 1
        self._header_ns, self._number = stamp_ns, number
        return 0 if self.repeats_stamps else stamp_ns

    def _row(self, names: list[str], count: int) -> int:
        """Row of the joint, -1 where it is missing."""
        if not self._joint:
            return 0 if count == 1 else -1
        try:
            row = names.index(self._joint)
        except ValueError:
            return -1
        return row if row < count else -1
