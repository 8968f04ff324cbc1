"""Who else is on the topics of the loop, and whether messages pass between them."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from backlash_ros.core.loop.figures import Peer, TopicFigures


def publishers_of(
    node: Node, topic: str, message_type: type[Any], qos: QoSProfile,
) -> TopicFigures:
    """Those who publish what the node listens to with this quality of service."""
    peers = [
        Peer(_name(info), _kind(info), _unfit(info, message_type, info.qos_profile, qos))
        for info in node.get_publishers_info_by_topic(topic)
    ]
    return TopicFigures(topic, message_type.__name__, tuple(peers))


def subscribers_of(node: Node, topic: str, message_type: type[Any]) -> TopicFigures:
    """Those who listen to what the node publishes on this topic."""
    own = node.get_fully_qualified_name()
    # As the middleware has it: rclpy keeps what was asked for, with zeros for "no limit".
    offered = [
        info.qos_profile for info in node.get_publishers_info_by_topic(topic) if _name(info) == own
    ]
    peers = [
        Peer(_name(info), _kind(info), _unfit(info, message_type, offered[0], info.qos_profile))
        for info in node.get_subscriptions_info_by_topic(topic) if offered
    ]
    return TopicFigures(topic, message_type.__name__, tuple(peers))


def _name(info: Any) -> str:
    # Programs without ROS have no node.
    if not info.node_name or info.node_name.startswith('_NODE_NAME_UNKNOWN'):
        return 'an unnamed node'
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def _kind(info: Any) -> str:
    return str(info.topic_type).rsplit('/', 1)[-1]


def _unfit(
    info: Any, message_type: type[Any], offered: QoSProfile, wanted: QoSProfile,
) -> str:
    package = message_type.__module__.split('.')[0]
    if info.topic_type != f'{package}/msg/{message_type.__name__}':
        return 'type'
    compatible, _ = qos_check_compatible(offered, wanted)
    if compatible != QoSCompatibility.ERROR:
        return ''
    unreliable = offered.reliability == ReliabilityPolicy.BEST_EFFORT \
        and wanted.reliability == ReliabilityPolicy.RELIABLE
    return 'reliability' if unreliable else 'qos'
