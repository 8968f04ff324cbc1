"""What the controller publishes besides its commands: every step, single quantities, G(z)."""

import time
from array import array
from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from math import inf, nan

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64, Float64MultiArray, MultiArrayDimension

from backlash_ros import topics
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import StateModel
from backlash_ros.core.simulation.run_record import learned_model_of, stated_deviations
from backlash_ros.nodes.runtime.messages import NO_EVENTS, LabelledArrayPublisher


class WatchPublisher:
    """Publishes `controller/watch/[<joint>/]<label>` for each label that is subscribed to.

    After v(k) comes the u that it led to, known with y(k+1): points of their loop.
    """

    PAUSE_S = 0.04  # after a message of a topic; a loop at 1 kHz has no time for many more

    def __init__(self, node: Node, joint: str) -> None:
        self._publishers = {
            label: node.create_publisher(
                Float64, topics.of_node(topics.watched(label, joint)), 10, event_callbacks=NO_EVENTS
            ) for label in topics.WATCH_LABELS
        }
        self.heard: list[str] = []
        self._due_s = -inf
        self._u_waits = False  # for the sample after that of the newest v

    def look(self) -> None:
        self.heard = [
            label for label, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        ]

    def follow(self, values: Mapping[str, float]) -> None:
        """Publish what is due of a sample."""
        due = time.monotonic() > self._due_s
        for label in self.heard:
            if self._u_waits if label == 'u_hat' else due:
                self._publishers[label].publish(Float64(data=values[label]))
        self._u_waits = due
        if due:
            self._due_s = time.monotonic() + self.PAUSE_S


class StepPublisher:
    """The topics ~/signals, ~/estimates and those below ~/watch.

    The rows of several joints stand one after the other; that of a joint without a step is nan.
    heard: whether anybody listened at the newest look: nothing is made for nobody.
    """

    heard = True

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._arrays = {
            topic: LabelledArrayPublisher(node, topics.of_node(topic), [
                topics.of_joint(label, joint) for joint in joints
                for label in topics.LABELS_OF[topic]
            ]) for topic in (topics.SIGNALS, topics.ESTIMATES)
        }
        self._watches = {joint: WatchPublisher(node, joint) for joint in joints}
        self._turns = cycle(self._watches.values())

    @property
    def listeners(self) -> int:
        return min(publisher.listeners for publisher in self._arrays.values())

    def look(self) -> None:
        """Look who listens; to ask at every sample would take a tenth of it."""
        next(self._turns).look()
        self.heard = any(publisher.listeners for publisher in self._arrays.values()) \
            or any(watch.heard for watch in self._watches.values())

    def publish(self, loops: Mapping[str, ControlLoop], steps: Mapping[str, ControlStep]) -> None:
        if self.heard:
            values = {joint: labelled(loops[joint], step) for joint, step in steps.items()}
            for topic, publisher in self._arrays.items():
                publisher.publish([
                    values[joint][label] if joint in values else nan
                    for joint in loops for label in topics.LABELS_OF[topic]
                ])
            for joint, of_joint in values.items():
                self._watches[joint].follow(of_joint)


def labelled(loop: ControlLoop, step: ControlStep) -> dict[str, float]:
    """What SIGNAL_LABELS, ESTIMATE_LABELS and WATCH_LABELS name, of the newest sample."""
    e, law = step.estimate, loop.core.estimator
    values = {
        'y_m': step.y_m, 'y': step.y, 'u_d': step.u_d, 'v': step.v, 'u_hat': law.u_hat,
        'innovation': law.innovation, 'status': float(e.status),
        'sample': float(loop.counter.index), 'latency_s': loop.statistics.latencies[-1],
        'f': e.f, 'std_f': nan, 'gap': e.c_r - e.c_l,
    }
    backlash = zip(topics.BACKLASH, (e.m, e.c_r, e.c_l), stated_deviations(e), strict=True)
    for name, value, std in backlash:
        values[name], values[f'std_{name}'] = value, std
        values[f'{name}_low'], values[f'{name}_high'] = value - 2.0 * std, value + 2.0 * std
    return values


class ModelPublisher:
    """Publishes `controller/model` when G has changed, else once per second of samples.

    These are counted, so that a run in lockstep is the same whenever it is made.
    """

    def __init__(self, node: Node, joint: str) -> None:
        # Who comes late gets the newest ones: G may never change again. More than one, so that a
        # subscriber that is held up misses none, and one of each joint.
        newest = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(
            Float64MultiArray, topics.of_node(topics.MODEL), newest, event_callbacks=NO_EVENTS
        )
        self._joint = joint
        # The newest one that followed a sample, and the number of that.
        self._told: tuple[StateModel | None, float] = None, -inf

    def follow(self, loop: ControlLoop, p: Parameters) -> None:
        learned, index, (told, told_index) = \
            loop.core.estimator.learned_model, loop.counter.index, self._told
        # Deviations and noise change with every few samples, and are of use to a reader.
        if learned is not told or (index - told_index) * p.sample_period >= 1.0:
            self._told = learned, index
            self.publish(loop, p)

    def publish(self, loop: ControlLoop, p: Parameters, wait_s: int = 0) -> None:
        """Publish at once. wait_s: how long at most until who listens has it."""
        fields = learned_model_of(loop.core.estimator, p)
        message = Float64MultiArray(data=array('d', chain(*fields.values())))
        message.layout.dim = [
            MultiArrayDimension(label=topics.of_joint(label, self._joint), size=len(values))
            for label, values in fields.items()
        ]
        self._publisher.publish(message)
        if wait_s:
            self._publisher.wait_for_all_acked(Duration(seconds=wait_s))
