"""What is published of every step of the controller."""

from __future__ import annotations

import time
from math import nan

from rclpy.node import Node

from backlash_ros import topics
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.control.watch_publisher import WatchPublisher
from backlash_ros.nodes.runtime.messages import LabelledArrayPublisher


class StepPublisher:
    """The topics ~/signals, ~/estimates and those below ~/watch."""

    def __init__(self, node: Node) -> None:
        self._signals = LabelledArrayPublisher(
            node, topics.of_node(topics.SIGNALS), topics.SIGNAL_LABELS
        )
        self._estimates = LabelledArrayPublisher(
            node, topics.of_node(topics.ESTIMATES), topics.ESTIMATE_LABELS
        )
        self._watch = WatchPublisher(node)

    @property
    def listeners(self) -> int:
        """How many subscribers there are to every step."""
        return min(self._signals.listeners, self._estimates.listeners)

    def publish(self, loop: ControlLoop, step: ControlStep) -> None:
        """Tell of a step."""
        e, sample = step.estimate, float(loop.counter.index)
        estimator = loop.core.estimator
        signals = (
            step.y_m, step.y, step.u_d, step.v, estimator.u_hat, estimator.innovation,
            float(e.status), sample, loop.statistics.latencies[-1],
        )
        estimates = (e.m, e.c_r, e.c_l, e.f, *stated_deviations(e), nan, sample)
        self._signals.publish(signals)
        self._estimates.publish(estimates)
        self._watch.follow(signals, estimates, time.monotonic())
