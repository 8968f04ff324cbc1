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

Row = tuple[float, ...]


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

    def follow(self, signals: Row, estimates: Row) -> None:
        """Publish what is due of a sample, given by its rows in the order of their labels."""
        now_s = time.monotonic()
        due = now_s > self._due_s
        if not (self.heard and (due or self._u_waits)):
            return
        values = watched_values(signals, estimates)
        for label in self.heard:
            if self._u_waits if label == 'u_hat' else due:
                self._publishers[label].publish(Float64(data=values[label]))
        self._u_waits = due
        if due:
            self._due_s = now_s + self.PAUSE_S


def watched_values(signals: Row, estimates: Row) -> dict[str, float]:
    """The value of each of WATCH_LABELS, nan for bands where the law has no deviations."""
    estimate = dict(zip(topics.ESTIMATE_LABELS, estimates, strict=True))
    values = dict(zip(topics.SIGNAL_LABELS, signals, strict=True))
    del values['sample']
    for name in topics.BACKLASH:
        value, half = estimate[name], 2.0 * estimate[f'std_{name}']
        values |= {name: value, f'{name}_low': value - half, f'{name}_high': value + half}
    return values | {'gap': estimate['c_r'] - estimate['c_l']}


class StepPublisher:
    """The topics ~/signals, ~/estimates and those below ~/watch.

    The rows of several joints stand one after the other; that of a joint without a step is nan.
    heard: whether anybody listened at the newest look: nothing is made for nobody.
    """

    heard = True

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._rows = [
            LabelledArrayPublisher(node, topics.of_node(topic), [
                topics.of_joint(label, joint) for joint in joints
                for label in topics.LABELS_OF[topic]
            ]) for topic in (topics.SIGNALS, topics.ESTIMATES)
        ]
        self._watches = {joint: WatchPublisher(node, joint) for joint in joints}
        self._turns = cycle(self._watches.values())

    @property
    def listeners(self) -> int:
        return min(publisher.listeners for publisher in self._rows)

    def look(self) -> None:
        """Look who listens; to ask at every sample would take a tenth of it."""
        next(self._turns).look()
        self.heard = any(publisher.listeners for publisher in self._rows) \
            or any(watch.heard for watch in self._watches.values())

    def publish(self, loops: Mapping[str, ControlLoop], steps: Mapping[str, ControlStep]) -> None:
        if self.heard:
            rows = {joint: _rows(loop, steps.get(joint)) for joint, loop in loops.items()}
            for publisher, row in zip(self._rows, zip(*rows.values(), strict=True), strict=True):
                publisher.publish([*chain(*row)])
            for joint in steps:
                self._watches[joint].follow(*rows[joint])


def _rows(loop: ControlLoop, step: ControlStep | None) -> tuple[Row, Row]:
    if step is None:
        return (nan,) * len(topics.SIGNAL_LABELS), (nan,) * len(topics.ESTIMATE_LABELS)
    e, sample, law = step.estimate, float(loop.counter.index), loop.core.estimator
    return (
        step.y_m, step.y, step.u_d, step.v, law.u_hat, law.innovation, float(e.status), sample,
        loop.statistics.latencies[-1],
    ), (e.m, e.c_r, e.c_l, e.f, *stated_deviations(e), nan, sample)


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
