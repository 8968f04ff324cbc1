"""Publish arrays and diagnostics, and convert the messages of every sample from and to bytes.

rclpy takes and publishes bytes in half the time of a std_msgs/Float64, and in a tenth of that of a
sensor_msgs/JointState of six joints. Four bytes name the encoding: the second is odd for
little-endian. The rest is aligned to its size (CDR: DDS Interoperability, 10.2).
"""

import time
from array import array
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import chain
from struct import Struct, pack, unpack_from
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from backlash_ros import topics
from backlash_ros.core.loop.diagnosis import UNNAMED, Finding, Level, LevelLog
from backlash_ros.nodes.runtime.process import emit

# Deep enough that a subscriber that is held up for a second misses nothing.
DEPTH = 1000
DIAGNOSTICS_PERIOD_S = 1.0  # of every node, besides each change
SILENT_S = 3.0 * DIAGNOSTICS_PERIOD_S  # silence after which a node counts as gone
# In lockstep a missed message would stop the loop for good, so late subscribers get it as well.
KEPT_QOS = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Publishers that the loop does not need report no incompatible subscribers: rclpy would check every
# event of every publisher whenever it serves the rest.
NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
CDR_FLOAT64 = Struct('<xBxxd')
LITTLE_ENDIAN = b'\x00\x01\x00\x00'


class LabelledArrayPublisher:
    """Publishes rows of numbers, with their labels in layout.dim."""

    def __init__(self, node: Node, topic: str, labels: Sequence[str]) -> None:
        self._publisher = node.create_publisher(
            Float64MultiArray, topic, DEPTH, event_callbacks=NO_EVENTS
        )
        self._message = Float64MultiArray()
        self._message.layout.dim = [MultiArrayDimension(label=label, size=1) for label in labels]

    @property
    def listeners(self) -> int:
        return self._publisher.get_subscription_count()

    def publish(self, row: Sequence[float]) -> None:
        if self.listeners:
            # rclpy takes an array as it is, but checks each element of a list.
            self._message.data = array('d', row)
            self._publisher.publish(self._message)


class DiagnosticsPublisher:
    """Publishes the state of a node, or of a part of it, to /diagnostics, and logs its changes."""

    def __init__(self, node: Node, hardware_id: str, part: str = '') -> None:
        self._node, self._part = node, part
        self._publisher = node.create_publisher(
            DiagnosticArray, topics.DIAGNOSTICS, 10, event_callbacks=NO_EVENTS
        )
        name = node.get_fully_qualified_name().strip('/') + (f': {part}' if part else '')
        self._status = DiagnosticStatus(name=name, hardware_id=hardware_id)
        self._log = LevelLog(self._write)

    def publish(self, finding: Finding, values: Mapping[str, object], logs: bool = True) -> None:
        """Publish a finding with values as details. logs: False if another part logs it."""
        self._status.level, self._status.message = bytes([finding.level]), finding.text
        self._status.values = [
            KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
            for key, value in values.items()
        ]
        message = DiagnosticArray(status=[self._status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        if logs:
            self._log.take(finding, time.monotonic())

    def _write(self, level: Level, text: str) -> None:
        log, line = Node.get_logger(self._node), line_of(self._part, text)
        # rclpy allows only one severity for each line of code.
        if level == Level.OK:
            log.info(line)
        elif level == Level.WARN:
            log.warning(line)
        else:
            log.error(line)
            emit('complaint', text=line)


def line_of(joint: str, text: str) -> str:
    """A line of the log about a joint, which is nameless if it is the only one."""
    return f'{joint}: {text}' if joint else text


def name_of(info: TopicEndpointInfo) -> str:
    """Full name of the node that has an endpoint."""
    # Names are discovered later than topics, and programs without ROS have none.
    if not info.node_name or 'UNKNOWN' in info.node_name:
        return UNNAMED
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def name_of_type(message_type: type[Any]) -> str:
    """Name of a type as in discovery and bags: std_msgs/msg/Float64."""
    return f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'


def arrival_ns(received_ns: int) -> int:
    """Convert the middleware's time of arrival of a message to the monotonic clock."""
    # If the clock was set back since, the arrival must not lie in the future.
    return time.monotonic_ns() - max(time.time_ns() - received_ns, 0)


def numbers_of(message: bytes) -> tuple[float, ...]:
    """The number in a std_msgs/Float64, as a tuple of one."""
    return (CDR_FLOAT64 if message[1] & 1 else Struct('>xBxxd')).unpack_from(message)[1:]


def message_with(number: float) -> bytes:
    """A std_msgs/Float64 as bytes."""
    return CDR_FLOAT64.pack(1, number)


class JointMessage(NamedTuple):
    """The content of a sensor_msgs/JointState without its frame. stamp_ns: of its header."""

    stamp_ns: int = 0
    name: tuple[str, ...] = ()
    position: Sequence[float] = ()
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()


class JointReader:
    """Reads JointState messages, fast if they are about the same joints as the one before."""

    def __init__(self) -> None:
        self._head = b''  # of the newest message, from its frame to its names
        self._name: tuple[str, ...] = ()

    def read(self, message: bytes) -> JointMessage:
        if not (self._head and message[1] & 1 and message.startswith(self._head, 12)):
            return self._read_all(message)
        seconds, nanoseconds = unpack_from('<iI', message, 4)
        at, fields = 12 + len(self._head), []
        for _ in range(3):
            count, = unpack_from('<I', message, at)
            at += 4
            if count:
                at += (4 - at) % 8  # alignment begins after the four bytes of the encoding
            fields.append(unpack_from(f'<{count}d', message, at))
            at += 8 * count
        return JointMessage(seconds * 10**9 + nanoseconds, self._name, *fields)

    def _read_all(self, message: bytes) -> JointMessage:
        state = deserialize_message(message, JointState)
        stamp, self._name = state.header.stamp, tuple(state.name)
        self._head = message[12:][:len(_head_of(state.header.frame_id, self._name))]
        fields = map(tuple, (state.position, state.velocity, state.effort))
        return JointMessage(stamp.sec * 10**9 + stamp.nanosec, self._name, *fields)


def joint_message(content: JointMessage) -> bytes:
    """A sensor_msgs/JointState without a frame, as bytes."""
    head, lists = _head_of('', content.name), content[2:]
    # In native mode struct aligns as CDR does.
    layout = ''.join(f'I{len(values)}d' if values else 'I' for values in lists)
    return LITTLE_ENDIAN + pack(
        f'@iI{len(head)}s{layout}', *divmod(content.stamp_ns, 10**9), head,
        *chain.from_iterable((len(values), *values) for values in lists),
    )


@lru_cache(maxsize=8)
def _head_of(frame: str, names: tuple[str, ...]) -> bytes:
    first, texts = frame.encode(), [name.encode() for name in names]
    layout = ''.join(f'I{len(text) + 1}s' for text in texts)
    sized = chain.from_iterable((len(text) + 1, text) for text in texts)
    return pack(f'@I{len(first) + 1}sI{layout}0I', len(first) + 1, first, len(texts), *sized)
