"""What the controller publishes for each step besides its commands, as rows and as numbers."""

import time
from collections.abc import Mapping, Sequence
from itertools import cycle
from math import inf, nan

from rclpy.node import Node
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.runtime.messages import NO_EVENTS, LabelledArrayPublisher


class StepPublisher:
    """The topics ~/signals, ~/estimates and those below ~/watch, one for each label.

    A message has the rows of all joints in turn, nan for a joint without a step. Below ~/watch,
    v(k) is followed by the u that it caused, known with y(k+1), so that both plot as a hysteresis.
    heard: whether anybody listened at the last look; if not, nothing is published.
    """

    WATCH_PAUSE_S = 0.04  # between messages below ~/watch; a loop at 1 kHz has no time for more

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._arrays = {
            topic: LabelledArrayPublisher(node, topics.of_node(topic), [
                topics.of_joint(label, joint) for joint in joints
                for label in topics.LABELS_OF[topic]
            ]) for topic in (topics.SIGNALS, topics.ESTIMATES)
        }
        self._watch = {joint: {
            label: node.create_publisher(
                Float64, topics.of_node(topics.watched(label, joint)), 10, event_callbacks=NO_EVENTS
            ) for label in topics.WATCH_LABELS
        } for joint in joints}
        self._watched: dict[str, list[str]] = {joint: [] for joint in joints}  # labels of each
        self._turns, self.heard = cycle(joints), True
        self._watch_due_s = -inf
        self._u_waits = False  # for the sample after that of the newest v

    @property
    def listeners(self) -> int:
        return min(publisher.listeners for publisher in self._arrays.values())

    def look(self) -> None:
        """See which topics have subscribers: to ask in every sample would take a tenth of it."""
        joint = next(self._turns)
        self._watched[joint] = [label for label, publisher in self._watch[joint].items()
                                if publisher.get_subscription_count()]
        self.heard = any(publisher.listeners for publisher in self._arrays.values()) \
            or any(self._watched.values())

    def publish(self, loops: Mapping[str, ControlLoop], steps: Mapping[str, ControlStep]) -> None:
        if not self.heard:
            return
        values = {joint: labelled(loops[joint], step) for joint, step in steps.items()}
        for topic, publisher in self._arrays.items():
            publisher.publish([
                values[joint][label] if joint in values else nan
                for joint in loops for label in topics.LABELS_OF[topic]
            ])
        due = time.monotonic() > self._watch_due_s
        for joint, of_joint in values.items():
            for label in self._watched[joint]:
                if self._u_waits if label == 'u_hat' else due:
                    self._watch[joint][label].publish(Float64(data=of_joint[label]))
        self._u_waits = due
        if due:
            self._watch_due_s = time.monotonic() + self.WATCH_PAUSE_S


def labelled(loop: ControlLoop, step: ControlStep) -> dict[str, float]:
    """Values for SIGNAL_LABELS, ESTIMATE_LABELS and WATCH_LABELS at the newest sample."""
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
