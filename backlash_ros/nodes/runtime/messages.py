"""Messages that are made once and published often."""

from __future__ import annotations

import time
from array import array
from collections.abc import Mapping, Sequence

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from backlash_ros import topics
from backlash_ros.core.loop.diagnosis import Finding, Level, LevelLog

# Deep enough that a recorder which is held up for a second misses nothing.
DEPTH = 1000
DIAGNOSTICS_PERIOD_S = 1.0  # of every node, besides each change
SILENT_S = 3.0 * DIAGNOSTICS_PERIOD_S  # after which a node that has said something is gone
# In lockstep a missed message would stop the loop for good: who comes late gets it all the same.
KEPT_QOS = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def without_events() -> PublisherEventCallbacks:
    """For publishers that the loop does not depend on: nobody is told of unfit subscribers."""
    # At every look at what is not urgent the executor goes through every event of every publisher.
    return PublisherEventCallbacks(use_default_callbacks=False)


class LabelledArrayPublisher:
    """Publishes rows of numbers whose labels stand in layout.dim."""

    def __init__(self, node: Node, topic: str, labels: Sequence[str]) -> None:
        self._publisher = node.create_publisher(
            Float64MultiArray, topic, DEPTH, event_callbacks=without_events()
        )
        self._message = Float64MultiArray()
        self._message.layout.dim = [MultiArrayDimension(label=label, size=1) for label in labels]

    @property
    def listeners(self) -> int:
        return self._publisher.get_subscription_count()

    def publish(self, row: Sequence[float]) -> None:
        """Publish one value per label, if anybody listens."""
        if self.listeners:
            # An array is taken as it is; a list would be checked element by element.
            self._message.data = array('d', row)
            self._publisher.publish(self._message)


class DiagnosticsPublisher:
    """Publishes the state of one node to /diagnostics, and its changes to the log.

    hardware_id: what the node has to do with. part: what of the node it is about, empty for all.
    """

    def __init__(self, node: Node, hardware_id: str, part: str = '') -> None:
        self._node, self._part = node, part
        self._publisher = node.create_publisher(
            DiagnosticArray, topics.DIAGNOSTICS, 10, event_callbacks=without_events()
        )
        name = node.get_fully_qualified_name().strip('/') + (f': {part}' if part else '')
        self._status = DiagnosticStatus(name=name, hardware_id=hardware_id)
        self._message = DiagnosticArray(status=[self._status])
        self._log = LevelLog(self._write)

    def publish(self, finding: Finding, values: Mapping[str, object], logs: bool = True) -> None:
        """finding: what is going on, and what to do if it is wrong. values: details to it.

        logs: False for what another part of the node has to say in the log.
        """
        self._status.level, self._status.message = bytes([finding.level]), finding.text
        self._status.values = [
            KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
            for key, value in values.items()
        ]
        self._message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(self._message)
        if logs:
            self._log.take(finding, time.monotonic())

    def _write(self, level: Level, text: str) -> None:
        log = Node.get_logger(self._node)
        text = f'{self._part}: {text}' if self._part else text
        # rclpy remembers a severity for each place in the code.
        if level == Level.OK:
            log.info(text)
        elif level == Level.WARN:
            log.warning(text)
        else:
            log.error(text)


def clock_message(stamp_ns: int) -> Clock:
    return Clock(clock=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9))


def stamp_ns_of(message: Clock) -> int:
    return int(message.clock.sec * 10**9 + message.clock.nanosec)


def arrival_ns(received_ns: int) -> int:
    """When a message arrived, on the monotonic clock, from what the middleware says of it."""
    # A clock that was set back since must not put it into the future.
    return time.monotonic_ns() - max(time.time_ns() - received_ns, 0)
