"""What discovery tells of a driver: who publishes y, who listens to v, with which QoS."""

import difflib
from collections.abc import Callable, Iterable, Sequence

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros import topics
from backlash_ros.core.driver_check import FLOAT64, Graph
from backlash_ros.core.parameters.table import RECORDER
from backlash_ros.nodes.runtime.messages import DEPTH


def publishers(node: Node, topic: str) -> list[TopicEndpointInfo]:
    """Who else publishes a topic."""
    return [info for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            if info.node_name != node.get_name()]


def profile(node: Node, topic: str) -> QoSProfile:
    """The QoS that hears whoever publishes a topic."""
    return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT if
                      _has_best_effort(publishers(node, topic)) else ReliabilityPolicy.RELIABLE)


def graph_around(node: Node) -> Graph:
    """Who is there now and, where nobody listens to v, which topics may have been meant for it."""
    control = node.resolve_topic_name(topics.CONTROL)
    outputs = publishers(node, topics.PLANT_OUTPUT)
    listeners = _others(node, node.get_subscriptions_info_by_topic(control))
    return Graph(
        len(outputs), tuple(sorted({info.topic_type for info in outputs})), len(listeners),
        tuple(sorted({_misfit(info.qos_profile) for info in listeners} - {''})),
        _has_best_effort(outputs), () if listeners else
        similar_topics(control, _topics(node, node.get_subscriptions_info_by_topic)))


def say_what_is_missing(node: Node) -> None:
    """Say which topic is waited for, and which ones there are."""
    wanted = node.resolve_topic_name(topics.PLANT_OUTPUT)
    seen = _topics(node, node.get_publishers_info_by_topic)
    print(f'waiting for {wanted} ({FLOAT64}), sees {", ".join(sorted(seen)) or "no topic"}', *(
        f'  if {near} ({", ".join(seen[near])}) is it: '
        f'--ros-args -r {topics.PLANT_OUTPUT}:={near}' for near in similar_topics(wanted, seen)
    ), sep='\n', flush=True)


def _topics(
    node: Node, endpoints: Callable[[str], list[TopicEndpointInfo]],
) -> dict[str, list[str]]:
    """Topics that others have such endpoints of, with their types, but for those of ROS."""
    return {topic: types for topic, types in node.get_topic_names_and_types()
            if topic not in ('/rosout', '/parameter_events') and _others(node, endpoints(topic))}


def _others(node: Node, endpoints: Sequence[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
    """Without those of this node, of the recorder and of `ros2 topic`."""
    return [info for info in endpoints if info.node_name not in (node.get_name(), RECORDER)
            and not info.node_name.startswith('_ros2cli')]


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
