"""What discovery tells of a driver: who publishes y, who listens to v, with which QoS."""

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros import topics
from backlash_ros.core.driver_check import FLOAT64, Graph
from backlash_ros.core.parameters.table import RECORDER
from backlash_ros.nodes.runtime.messages import DEPTH


class DriverGraph:
    """The topics of a loop as a node sees them. names: their full names."""

    def __init__(self, node: Node, names: Mapping[str, str]) -> None:
        self._node, self._names = node, names
        self._graph = Graph()

    def publishers(self, topic: str) -> list[TopicEndpointInfo]:
        """Who else publishes a topic."""
        return [info for info in self._node.get_publishers_info_by_topic(self._names[topic])
                if info.node_name != self._node.get_name()]

    def profile(self, topic: str) -> QoSProfile:
        """The QoS that hears whoever publishes a topic."""
        return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT if
                          _has_best_effort(self.publishers(topic)) else ReliabilityPolicy.RELIABLE)

    def look(self) -> None:
        """Take note of who is there now."""
        graph, outputs = self._graph, self.publishers(topics.PLANT_OUTPUT)
        listeners = self._others(
            self._node.get_subscriptions_info_by_topic(self._names[topics.CONTROL]))
        graph.publishers = max(graph.publishers, len(outputs))
        graph.listeners = max(graph.listeners, len(listeners))
        if outputs:
            graph.types = tuple(sorted({info.topic_type for info in outputs}))
        graph.best_effort |= _has_best_effort(outputs)
        misfits = {_misfit(info.qos_profile) for info in listeners} - {''}
        graph.misfits = tuple(sorted({*graph.misfits, *misfits}))

    def in_the_end(self) -> Graph:
        """All that was noted, with topics that may have been meant for v."""
        listened_to = self._topics(self._node.get_subscriptions_info_by_topic)
        self._graph.near_control = similar_topics(self._names[topics.CONTROL], listened_to)
        return self._graph

    def say_what_is_missing(self) -> None:
        """Say which topic is waited for, and which ones there are."""
        wanted = self._names[topics.PLANT_OUTPUT]
        seen = self._topics(self._node.get_publishers_info_by_topic)
        print(f'waiting for {wanted} ({FLOAT64}), sees {", ".join(sorted(seen)) or "no topic"}',
              flush=True)
        for near in similar_topics(wanted, seen):
            print(f'  if {near} ({", ".join(seen[near])}) is it: --ros-args -r '
                  f'{topics.PLANT_OUTPUT}:={near}', flush=True)

    def _topics(self, endpoints: Callable[[str], list[TopicEndpointInfo]]) -> dict[str, list[str]]:
        """Topics that others have such endpoints of, with their types, but for those of ROS."""
        return {topic: types for topic, types in self._node.get_topic_names_and_types()
                if topic not in ('/rosout', '/parameter_events') and self._others(endpoints(topic))}

    def _others(self, endpoints: Sequence[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
        """Without those of this node, of the recorder and of `ros2 topic`."""
        own = (self._node.get_name(), RECORDER)
        return [info for info in endpoints
                if info.node_name not in own and not info.node_name.startswith('_ros2cli')]


def _has_best_effort(endpoints: Sequence[TopicEndpointInfo]) -> bool:
    return any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in endpoints)


def _misfit(asked: QoSProfile) -> str:
    """Why messages cannot pass from control to a subscriber, empty if they can."""
    # What discovery does not tell (depth) or tells as "infinite" would count as a misfit.
    bare = QoSProfile(depth=DEPTH, reliability=asked.reliability, durability=asked.durability)
    compatibility, reason = qos_check_compatible(QoSProfile(depth=DEPTH), bare)
    return f'control: {reason}' if compatibility == QoSCompatibility.ERROR else ''


def similar_topics(wanted: str, seen: Iterable[str]) -> tuple[str, ...]:
    """Topics that may be the wanted one under another name, by the last part of it."""
    last = wanted.rpartition('/')[2]
    return tuple(topic for topic in sorted(seen) if topic != wanted and
                 difflib.SequenceMatcher(None, last, topic.rpartition('/')[2]).ratio() >= 0.6)
