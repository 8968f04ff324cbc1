"""What the driver says and is told, by joint, in the messages that io.style names."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Mapping
from math import nan
from typing import Any, NamedTuple

from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.loop.command_history import KEPT_COMMANDS
from backlash_ros.core.loop.sample_counter import Output, Timing
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.nodes.runtime.executor import serve_polled
from backlash_ros.nodes.runtime.messages import DEPTH
from backlash_ros.nodes.runtime.process import ProcessNode
from backlash_ros.nodes.runtime.wire import (
    JointMessage,
    JointReader,
    joint_message,
    message_with,
    number_of,
)


class DriverTopics(NamedTuple):
    """Where y_m and y come from, where v goes to, and where the driver reports it."""

    reference: str
    reference_type: type[Any]
    output: str
    output_type: type[Any]
    control: str
    control_type: type[Any]
    applied: str
    applied_type: type[Any]


def driver_topics(p: Parameters) -> DriverTopics:
    """The topics and types that io.style, io.command and joints ask for."""
    style, to = p.io.style, topics
    of_joints = bool(p.joints) or style == 'joint_state_topic'
    applied = (to.APPLIED_JOINT_COMMANDS, JointState) if of_joints \
        else (to.APPLIED_CONTROL, Float64)
    array = to.JOINT_COMMANDS, Float64MultiArray
    if style == 'joint_state_topic':
        control = array if p.io.command == 'array' else (to.JOINT_STATE_COMMANDS, JointState)
        return DriverTopics(
            to.ROBOT_COMMAND, JointState, to.ROBOT_STATES, JointState, *control, *applied
        )
    reference = to.REFERENCE, JointState if of_joints else Float64
    if style == 'ros2_control':
        return DriverTopics(*reference, to.JOINT_STATES, JointState, *array, *applied)
    return DriverTopics(*reference, to.PLANT_OUTPUT, Float64, to.CONTROL, Float64, *applied)


def check_style(p: Parameters) -> None:
    """Raise ParameterError where the messages of io.style cannot carry what is asked for."""
    style = p.io.style
    if p.lockstep and style != 'native':
        raise ParameterError('lockstep', True, 'needs io.style: native')
    if p.joints and style == 'native':
        raise ParameterError(
            'io.style', style, 'has messages for one joint only',
            'set joint_state_topic or ros2_control',
        )
    if style == 'joint_state_topic' and not (p.joints or p.io.joint):
        raise ParameterError('joints', (), 'is empty', f'name them, io.style is {style}')


def output_qos(p: Parameters, depth: int) -> QoSProfile:
    """How y is listened to."""
    return QoSProfile(depth=depth, reliability=(
        ReliabilityPolicy.BEST_EFFORT if p.io.best_effort else ReliabilityPolicy.RELIABLE
    ))


class HeaderStamps:
    """Stamps in the headers of the driver's messages, as far as they tell the time.

    repeated: whether a stamp came twice; since then the time of sending counts.
    """

    def __init__(self) -> None:
        self.repeated = False
        self._stamp_ns = self._number = 0  # of the newest message

    def told(self, stamp_ns: int, number: int, publishers: Callable[[], int]) -> int:
        """The stamp of a message with this number; 0 where it tells no time.

        publishers: how many there are: two with the same stamps are told apart by their numbers,
        mostly.
        """
        again = stamp_ns == self._stamp_ns != 0 and number == self._number + 1
        if again and not self.repeated:
            self.repeated = publishers() == 1
        self._stamp_ns, self._number = stamp_ns, number
        return 0 if self.repeated else stamp_ns


class DriverIo:
    """What a node says to the driver and hears from it.

    Joints are told apart by name; the only one of a controller without `joints` is nameless, and
    io.joint says what it is called in messages.

    joint_names: in the order of their commands in an array. skipped: messages in a row without a
    joint. seen: the joints of the newest of these. simulated_time: whether stamps are those of
    /clock. publisher: of v, once it is advertised.
    """

    publisher: Publisher

    def __init__(self, node: ProcessNode, p: Parameters) -> None:
        self.topics, self.joint_names = driver_topics(p), p.joint_names
        self.skipped, self.seen = dict.fromkeys(p.joint_names, 0), ''
        self.stamps = HeaderStamps()
        # On simulated time the stamps of the middleware, which are real time, say nothing.
        self.simulated_time = bool(node.get_parameter('use_sim_time').value)
        self._node, self._p = node, p
        self._newest: dict[str, float] = {}  # v by joint
        self._referred = JointMessage()  # the newest message of references
        self._heard: dict[str, Subscription] = {}  # by what they are about

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

    def known_of(self, timing: Timing) -> Timing:
        """What the stamps of the messages tell of the driver."""
        # Those of simulated time have nothing to do with the time of arrival.
        age_s = nan if self.simulated_time else timing.age_s
        return timing._replace(age_s=age_s, repeats_stamps=self.stamps.repeated)

    def listen(
        self, hear: Callable[[Mapping[str, Output]], None], depth: int, polled: bool = False,
    ) -> Subscription:
        """Call hear with every y. polled: when serve_polled is called."""
        def hear_number(message: bytes, info: dict[str, Any]) -> None:
            hear({'': Output(
                number_of(message), self.stamp_ns(info), info['source_timestamp'],
                info['received_timestamp'], info['publication_sequence_number'],
            )})

        reader = JointReader()

        def hear_joints(content: bytes, info: dict[str, Any]) -> None:
            message = reader.read(content)
            values = self.values(message)
            if len(values) < len(self.joint_names):
                self.seen = ', '.join(message.name)
                for joint in self.joint_names:
                    self.skipped[joint] = 0 if joint in values else self.skipped[joint] + 1
            elif any(self.skipped.values()):
                self.skipped = dict.fromkeys(self.joint_names, 0)
            if not values:
                return
            number = info['publication_sequence_number']
            stamp_ns = self.stamps.told(
                message.stamp_ns, number, lambda: self._node.count_publishers(self.topics.output),
            )
            # Drivers that leave the header empty are known by the stamp of the middleware.
            of_all = (
                stamp_ns or self.stamp_ns(info), info['source_timestamp'],
                info['received_timestamp'], number, False,
            )
            hear({joint: Output(y, *of_all) for joint, y in values.items()})

        of_joints = self.topics.output_type is JointState
        return self._node.listen(
            self.topics.output_type, self.topics.output, hear_joints if of_joints else hear_number,
            output_qos(self._p, depth), raw=True, polled=polled,
        )

    def listen_to_references(
        self, hear: Callable[[Mapping[str, float]], None], qos: QoSProfile | int, polled: bool,
    ) -> None:
        """Call hear with every y_m. polled: when serve_waiting is called."""
        of_joints, reader = self.topics.reference_type is JointState, JointReader()

        def hear_values(content: bytes, info: dict[str, Any]) -> None:
            if of_joints:
                self._referred = reader.read(content)
            hear(self.values(self._referred) if of_joints else {'': number_of(content)})

        self._heard['references'] = self._node.listen(
            self.topics.reference_type, self.topics.reference, hear_values, qos, True, polled,
        )

    @property
    def reference_qos(self) -> QoSProfile:
        """How y_m is listened to."""
        return self._heard['references'].qos_profile

    def serve_waiting(self) -> None:
        """Hear the references and reports that have come; not in lockstep, where nothing waits."""
        for subscription in self._heard.values():
            serve_polled(subscription)

    def listen_to_commands(self, hear: Callable[[Mapping[str, float]], None]) -> Subscription:
        """Call hear with every v that anybody sends to the driver."""
        return self._node.create_subscription(
            self.topics.control_type, self.topics.control,
            lambda message: hear(self.values(message)), 1,
        )

    def values(
        self, message: Float64 | Float64MultiArray | JointState | JointMessage,
    ) -> dict[str, float]:
        """What a message says about the joints of this node, by their names."""
        names = self.joint_names
        if isinstance(message, Float64):
            return {'': message.data}
        if isinstance(message, Float64MultiArray):
            fits = len(message.data) == len(names)
            return dict(zip(names, message.data, strict=True)) if fits else {}
        values, own = getattr(message, self._p.io.field), self._p.io.joint
        if names == ('',) and not own:
            return {'': values[0]} if len(values) == 1 else {}
        found = dict(zip(message.name, values, strict=False))
        return {joint: found[joint or own] for joint in names if (joint or own) in found}

    def advertise(self) -> Publisher:
        """Make the publisher of v."""
        self.publisher = self._node.create_publisher(
            self.topics.control_type, self.topics.control, DEPTH
        )
        return self.publisher

    def publish(self, commands: Mapping[str, float]) -> None:
        """Send v, by joint, to the driver; an array as soon as there is a v of every joint."""
        if self.topics.control_type is Float64MultiArray:
            self._newest.update(commands)
            if len(self._newest) == len(self.joint_names):
                data = array('d', map(self._newest.__getitem__, self.joint_names))
                self.publisher.publish(Float64MultiArray(data=data))
            return
        # What rclpy would do after it has found out that these are bytes.
        self.publisher.handle.publish_raw(
            message_with(commands['']) if self.topics.control_type is Float64
            else joint_message(self._joint_state(commands)))

    def _joint_state(self, commands: Mapping[str, float]) -> JointMessage:
        """v, and what the newest reference says of the joints besides."""
        names = tuple(joint or self._p.io.joint for joint in commands)
        row, fields = {name: i for i, name in enumerate(self._referred.name)}, {}
        for field in ('position', 'velocity', 'effort'):
            passed = getattr(self._referred, field)
            if field == self._p.io.field:
                fields[field] = tuple(commands.values())
            elif all(row.get(name, len(passed)) < len(passed) for name in names):
                fields[field] = tuple(passed[row[name]] for name in names)
        return JointMessage(self.now_ns(), names, **fields)

    def listen_to_reports(self, hear: Callable[[Mapping[str, float], int], None]) -> None:
        """Call hear with each v that the driver reports to have applied, and its stamp [ns].

        That is when serve_waiting is called.
        """
        read, of_joints = JointReader().read, self.topics.applied_type is JointState

        def hear_values(content: bytes, info: dict[str, Any]) -> None:
            hear(self.values(read(content)) if of_joints else {'': number_of(content)},
                 self.stamp_ns(info))

        self._heard['reports'] = self._node.listen(
            self.topics.applied_type, self.topics.applied, hear_values, KEPT_COMMANDS, raw=True,
            polled=True,
        )

    @property
    def has_reports(self) -> bool:
        """Whether the driver reports what it has applied."""
        reports = self._heard.get('reports')
        return reports is not None and reports.get_publisher_count() > 0
