"""Messages from and to the driver, by joint, of the types that io.style names."""

import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property
from math import nan
from typing import Any, NamedTuple

from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.loop import diagnosis
from backlash_ros.core.loop.control_loop import Driver
from backlash_ros.core.loop.sample_counter import Output, Timing
from backlash_ros.core.loop.wall_clock import WallClock
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.executor import server_of
from backlash_ros.nodes.runtime.messages import DEPTH, JointMessage, line_of, name_of
from backlash_ros.nodes.runtime.process import ProcessNode


class DriverTopics(NamedTuple):
    """Topics of y_m, of y, of v, and of the v that the driver reports. types: message by topic."""

    reference: str
    output: str
    control: str
    applied: str
    types: dict[str, type[Any]]


def driver_topics(p: Parameters) -> DriverTopics:
    of_joints = bool(p.joints) or p.io.style == 'joint_state_topic'
    commands = topics.JOINT_COMMANDS if p.io.command == 'array' else topics.JOINT_STATE_COMMANDS
    names = (*{
        'native': (topics.REFERENCE, topics.PLANT_OUTPUT, topics.CONTROL),
        'ros2_control': (topics.REFERENCE, topics.JOINT_STATES, topics.JOINT_COMMANDS),
        'joint_state_topic': (topics.ROBOT_COMMAND, topics.ROBOT_STATES, commands),
    }[p.io.style], topics.APPLIED_JOINT_COMMANDS if of_joints else topics.APPLIED_CONTROL)
    types: dict[str, type[Any]] = dict.fromkeys(names, JointState) | {
        topics.PLANT_OUTPUT: Float64, topics.CONTROL: Float64, topics.APPLIED_CONTROL: Float64,
        topics.JOINT_COMMANDS: Float64MultiArray,
        topics.REFERENCE: JointState if of_joints else Float64,
    }
    return DriverTopics(*names, types)


def check_style(p: Parameters) -> None:
    """Raise ParameterError if the messages of io.style cannot carry what is asked for."""
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
    return QoSProfile(depth=depth, reliability=(
        ReliabilityPolicy.BEST_EFFORT if p.io.best_effort else ReliabilityPolicy.RELIABLE
    ))


class DriverIo:
    """Publishes to the driver and subscribes to it, by joint.

    The only joint of a controller without `joints` is nameless; io.joint is its name in messages.
    skipped: by joint, the number of messages in a row without it. seen: the joints in the newest of
    these. heard: subscriptions by topic.
    """

    publisher: Publisher

    def __init__(self, node: ProcessNode) -> None:
        p = node.settings
        self.topics = driver_topics(p)
        self._names = {joint: joint or p.io.joint for joint in p.joint_names}  # in messages
        self.skipped, self.seen = dict.fromkeys(p.joint_names, 0), ''
        self._node = node
        self._stamp = 0, 0  # in the header of the newest y, and the number of that message
        self.clock = WallClock()
        self._repeats_stamps = False  # if headers do, the time of sending is used
        self._newest: dict[str, float] = {}  # v by joint
        self._referred = JointMessage()  # the newest message of references
        self.heard: dict[str, Subscription] = {}
        self._waiting: list[Callable[[], None]] = []  # serve the references and the reports

    @cached_property
    def simulated_time(self) -> bool:
        """Whether stamps are of /clock, while those of the middleware are real time."""
        return bool(self._node.get_parameter('use_sim_time').value)

    @property
    def is_simulated(self) -> bool:
        """Whether y comes from the plant of this package, the only one with the topic TRUTH."""
        return self._node.count_publishers(topics.TRUTH) > 0

    def driver_of(self, joint: str) -> Driver:
        """What a loop can ask about its driver; of the simulated plant nothing is asked."""
        @cache
        def warn_once(text: str) -> None:
            if not self.is_simulated:
                self._node.log.warning(line_of(joint, text))

        def may_report() -> bool:
            return self._node.count_publishers(self.topics.applied) > 0 and not self.is_simulated

        return Driver(self.now_ns, may_report, self.topics.applied, warn_once,
                      wall_ns=lambda: time.time_ns() - self.clock.set_ns)

    def now_ns(self) -> int:
        # time.time_ns() is the system clock of ROS, but faster.
        return self._node.get_clock().now().nanoseconds if self.simulated_time \
            else time.time_ns() - self.clock.set_ns

    def stamp_ns(self, info: dict[str, Any]) -> int:
        """When a message was sent."""
        return self.now_ns() if self.simulated_time \
            else int(info['source_timestamp']) - self.clock.of_stamps_ns

    def arrival_ns(self, output: Output) -> int:
        """When an output arrived, on the monotonic clock."""
        return messages.arrival_ns(output.received_ns + self.clock.set_ns)

    def known_of(self, timing: Timing) -> Timing:
        # Simulated stamps cannot be compared with the time of arrival.
        age_s = nan if self.simulated_time else timing.age_s
        return timing._replace(age_s=age_s, repeats_stamps=self._repeats_stamps)

    def listen(
        self, hear: Callable[[Mapping[str, Output]], None], depth: int, polled: bool = False,
    ) -> Subscription:
        """Call hear with every y, by joint. polled: only in serve_polled."""
        numbered = self.topics.types[self.topics.output] is Float64

        def hear_output(
            values: dict[str, float], info: dict[str, Any],
            message: tuple[float, ...] | JointMessage,
        ) -> None:
            number, source_ns = info['publication_sequence_number'], info['source_timestamp']
            stamp_ns = 0
            if isinstance(message, JointMessage):
                if len(values) < len(self.skipped):
                    self.seen = ', '.join(message.name)
                for joint, skipped in self.skipped.items():
                    self.skipped[joint] = 0 if joint in values else skipped + 1
                if not values:
                    return
                before, self._stamp = self._stamp, (message.stamp_ns, number)
                if message.stamp_ns and self._stamp == (before[0], before[1] + 1):
                    # Two publishers may send the same stamps; mostly their numbers differ.
                    self._repeats_stamps = self._repeats_stamps \
                        or self._node.count_publishers(self.topics.output) == 1
                stamp_ns = 0 if self._repeats_stamps else message.stamp_ns
            if not self.simulated_time:
                # If the driver leaves the header empty, the stamp of the middleware is used.
                stamp_ns = stamp_ns or source_ns
                self.clock.look_now(stamp_ns)
            of_stamps_ns = self.clock.of_stamps_ns
            known = (stamp_ns - of_stamps_ns if stamp_ns else self.now_ns(),
                     source_ns - of_stamps_ns,
                     info['received_timestamp'] - self.clock.set_ns, number, numbered)
            hear({joint: Output(y, *known) for joint, y in values.items()})

        qos = output_qos(self._node.settings, depth)
        return self.listen_to(self.topics.output, hear_output, qos, polled)

    def listen_to(
        self, topic: str, hear: Callable[[dict[str, float], dict[str, Any], Any], None],
        qos: QoSProfile | int, polled: bool = True,
    ) -> Subscription:
        """Call hear with values by joint, info, and content. polled: only when it is served."""
        kind = self.topics.types[topic]
        readers: dict[type[Any], Callable[[bytes], Any]] = {
            Float64: messages.numbers_of, JointState: messages.JointReader().read,
            Float64MultiArray: lambda content: deserialize_message(content, Float64MultiArray).data,
        }
        read, refers = readers[kind], kind is JointState and topic == self.topics.reference

        def hear_content(content: bytes, info: dict[str, Any]) -> None:
            message = read(content)
            if refers:
                self._referred = message
            hear(self.values(message), info, message)

        self.heard[topic] = heard = self._node.listen(kind, topic, hear_content, qos, True, polled)
        if polled and topic != self.topics.output:
            self._waiting.append(server_of(heard))
        return heard

    def serve_waiting(self) -> None:
        """Take the waiting references and reports; in lockstep neither is polled."""
        for serve in self._waiting:
            serve()

    def values(self, message: Sequence[float] | JointMessage) -> dict[str, float]:
        """The values in a message for the joints of this node, by their names."""
        names = self._names
        if not isinstance(message, JointMessage):
            values = message
        else:
            values = getattr(message, self._node.settings.io.field)
            if any(names.values()):
                found = dict(zip(message.name, values, strict=False))
                return {joint: found[name] for joint, name in names.items() if name in found}
        # Without names, values are in the order of the joints.
        return dict(zip(names, values, strict=True)) if len(values) == len(names) else {}

    def advertise(self) -> None:
        topic = self.topics.control
        self.publisher = self._node.create_publisher(self.topics.types[topic], topic, DEPTH)

    def publish(self, commands: Mapping[str, float]) -> None:
        """Send v, by joint, to the driver; an array is sent once every joint has had a v."""
        kind = self.topics.types[self.topics.control]
        if kind is Float64MultiArray:
            self._newest.update(commands)
            if len(self._newest) == len(self.skipped):
                data = array('d', map(self._newest.__getitem__, self._names))
                self.publisher.publish(Float64MultiArray(data=data))
            return
        # As rclpy does once it has found out that these are bytes.
        self.publisher.handle.publish_raw(
            messages.message_with(commands['']) if kind is Float64
            else messages.joint_message(self._joint_state(commands)))

    def _joint_state(self, commands: Mapping[str, float]) -> JointMessage:
        """v, and the other fields of the joints as in the newest reference."""
        names = tuple(map(self._names.__getitem__, commands))
        row, fields = {name: i for i, name in enumerate(self._referred.name)}, {}
        for field in ('position', 'velocity', 'effort'):
            passed = getattr(self._referred, field)
            if field == self._node.settings.io.field:
                fields[field] = tuple(commands.values())
            elif all(row.get(name, len(passed)) < len(passed) for name in names):
                fields[field] = tuple(passed[row[name]] for name in names)
        return JointMessage(self.now_ns(), names, **fields)

    def neighbours(self, rivals: tuple[str, ...]) -> diagnosis.Neighbours:
        """Who is on the topics of the controller. rivals: other publishers of v."""
        node, (y_m, y, v, _, types) = self._node, self.topics
        publishers, own_name = node.get_publishers_info_by_topic, node.get_fully_qualified_name()
        # The QoS as the middleware has it: rclpy keeps what was asked for, with 0 for no limit.
        own = [info for info in publishers(v) if name_of(info) == own_name][:1]
        references, outputs = self.heard[y_m].qos_profile, output_qos(self._node.settings, DEPTH)
        # By topic: each endpoint with the QoS that is offered and that is wanted.
        there = {
            y: [(info, info.qos_profile, outputs) for info in publishers(y)],
            y_m: [(info, info.qos_profile, references) for info in publishers(y_m)],
            v: [(info, each.qos_profile, info.qos_profile)
                for each in own for info in node.get_subscriptions_info_by_topic(v)],
        }
        output, reference, control = (
            diagnosis.TopicFigures(topic, types[topic].__name__, tuple(
                diagnosis.Peer(name_of(info), info.topic_type.rpartition('/')[2],
                               _misfit(info.topic_type, types[topic], *qos)) for info, *qos in found
            )) for topic, found in there.items()
        )
        return diagnosis.Neighbours(output, reference, control, rivals)


def _misfit(sent: str, kind: type[Any], offers: QoSProfile, wants: QoSProfile) -> str:
    """Why no message passes, in the words of diagnosis.Peer, or ''."""
    if sent != messages.name_of_type(kind):
        return 'type'
    if qos_check_compatible(offers, wants)[0] != QoSCompatibility.ERROR:
        return ''
    unreliable = offers.reliability == ReliabilityPolicy.BEST_EFFORT \
        and wants.reliability == ReliabilityPolicy.RELIABLE
    return 'reliability' if unreliable else 'qos'
