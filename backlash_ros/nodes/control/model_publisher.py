"""Publishes what the controller believes of G."""

from __future__ import annotations

from array import array
from math import inf

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from backlash_ros import topics
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.learned_model import learned_model_of
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.nodes.runtime.messages import without_events

# Who comes late gets the newest ones: G may never change again. More than one, so that a subscriber
# that is held up misses none, and one of each joint.
NEWEST = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Deviations and noise change with every few samples, and are of use at the pace of a reader [s].
PERIOD_S = 1.0


class ModelPublisher:
    """Publishes `controller/model` when G has changed, else once per PERIOD_S of samples.

    Counted in samples, so that a run in lockstep is the same whenever it is made. A message is
    about one joint, whose name is part of the labels.
    """

    def __init__(self, node: Node, joint: str) -> None:
        self._publisher = node.create_publisher(
            Float64MultiArray, topics.of_node(topics.MODEL), NEWEST,
            event_callbacks=without_events(),
        )
        self._joint = joint
        self._told: StateModel | None = None  # the newest one that followed a sample
        self._since = inf  # samples since then

    def follow(self, loop: ControlLoop, sample_period_s: float) -> None:
        """Publish after a sample, if it is time."""
        self._since += 1
        learned = loop.core.estimator.learned_model
        if learned is not self._told or self._since * sample_period_s >= PERIOD_S:
            self._told, self._since = learned, 0
            self.publish(loop)

    def publish(self, loop: ControlLoop) -> None:
        """Publish at once."""
        fields = learned_model_of(loop.core.estimator, loop.told).fields()
        message = Float64MultiArray()
        message.layout.dim = [
            MultiArrayDimension(label=topics.of_joint(label, self._joint), size=len(values))
            for label, values in fields.items()
        ]
        message.data = array('d', [value for values in fields.values() for value in values])
        self._publisher.publish(message)
