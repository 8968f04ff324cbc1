"""What discovery tells of a driver: who publishes y, who listens to v, with which QoS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rclpy.node import Node
from rclpy.qos import (
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros import topics
from backlash_ros.core.driver_check.findings import FLOAT64, Graph
from backlash_ros.core.driver_check.verdict import similar_topics
from backlash_ros.core.parameters.table import RECORDER
from backlash_ros.nodes.control.rivals import names_of
from backlash_ros.nodes.runtime.messages import DEPTH

NOT_OURS = {'/rosout', '/parameter_events'}
COMMAND_LINE = '_ros2cli'  # how the nodes of `ros2 topic` are called


class DriverGraph:
    """The topics of a loop as a node sees them. names: their full names."""

    def __init__(self, node: Node, names: Mapping[str, str]) -> None:
        self._node, self._names = node, names
        self._graph = Graph()

    def outputs(self) -> list[TopicEndpointInfo]:
        """Who publishes y."""
        found: list[TopicEndpointInfo] = self._node.get_publishers_info_by_topic(
            self._names[topics.PLANT_OUTPUT]
        )
        return found

    def rivals(self) -> str:
        """Who else publishes v, empty for nobody."""
        others = self._node.get_publishers_info_by_topic(self._names[topics.CONTROL])
        return names_of([info for info in others if info.node_name != self._node.get_name()])

    def look(self) -> None:
        """Take note of who is there now."""
        graph = self._graph
        outputs = self.outputs()
        listeners = self._of_others(
            self._node.get_subscriptions_info_by_topic(self._names[topics.CONTROL])
        )
        graph.publishers = max(graph.publishers, len(outputs))
        graph.listeners = max(graph.listeners, len(listeners))
        if outputs:
            graph.types = tuple(sorted({info.topic_type for info in outputs}))
        graph.best_effort = graph.best_effort or any(
            info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in outputs
        )
        misfits = {
            reason for info in listeners
            if (reason := _misfit(QoSProfile(depth=DEPTH), info.qos_profile))
        }
        graph.misfits = tuple(sorted({*graph.misfits, *misfits}))

    def in_the_end(self) -> Graph:
        """All that was noted, with topics that may have been meant for v."""
        seen = self._topics_with(self._node.get_subscriptions_info_by_topic)
        self._graph.near_control = tuple(
            similar_topics(self._names[topics.CONTROL], FLOAT64, seen)
        )
        return self._graph

    def profile(self, topic: str) -> QoSProfile:
        """The QoS that hears whoever publishes a topic."""
        offered = self._node.get_publishers_info_by_topic(self._names[topic])
        reliable = all(
            info.qos_profile.reliability != ReliabilityPolicy.BEST_EFFORT for info in offered
        )
        return QoSProfile(depth=DEPTH, reliability=(
            ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        ))

    def say_what_is_missing(self) -> None:
        """Say which topic is waited for, and which ones there are."""
        wanted = self._names[topics.PLANT_OUTPUT]
        seen = self._topics_with(self._node.get_publishers_info_by_topic)
        print(f'waiting for {wanted} ({FLOAT64})')
        near = similar_topics(wanted, FLOAT64, seen)
        for topic in near:
            print(f'  sees {topic} ({", ".join(seen[topic])}); if that is it: '
                  f'--ros-args -r {topics.PLANT_OUTPUT}:={topic}')
        others = sorted(set(seen) - set(near))
        print(f'  sees {"besides " if near else ""}{", ".join(others) or "no other topic"}',
              flush=True)

    def _topics_with(
        self, endpoints: Callable[[str], list[TopicEndpointInfo]],
    ) -> dict[str, list[str]]:
        """Topics that have such endpoints, and their types."""
        return {
            topic: types for topic, types in self._node.get_topic_names_and_types()
            if topic not in NOT_OURS and self._of_others(endpoints(topic))
        }

    def _of_others(self, endpoints: Sequence[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
        """Without those of this node, of the recorder and of `ros2 topic`."""
        return [
            info for info in endpoints
            if info.node_name not in (self._node.get_name(), RECORDER)
            and not info.node_name.startswith(COMMAND_LINE)
        ]


def _misfit(offered: QoSProfile, asked: QoSProfile) -> str:
    """Why messages cannot pass from control to a subscriber, empty if they can."""
    # What discovery does not tell (depth) or tells as "infinite" would count as a misfit.
    bare = QoSProfile(depth=DEPTH, reliability=asked.reliability, durability=asked.durability)
    compatibility, reason = qos_check_compatible(offered, bare)
    return f'control: {reason}' if compatibility == QoSCompatibility.ERROR else ''
