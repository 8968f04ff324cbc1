"""What is published of every step of the controller."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from math import nan

from rclpy.node import Node

from backlash_ros import topics
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.control.watch_publisher import WatchPublisher
from backlash_ros.nodes.runtime.messages import LabelledArrayPublisher

Row = tuple[float, ...]


class StepPublisher:
    """The topics ~/signals, ~/estimates and those below ~/watch.

    The rows of several joints are one after the other, with the joint before each label; that of a
    joint without a step is nan.
    """

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self._signals, self._estimates = (
            LabelledArrayPublisher(node, topics.of_node(topic), [
                topics.of_joint(label, joint) for joint in joints for label in labels
            ]) for topic, labels in (
                (topics.SIGNALS, topics.SIGNAL_LABELS), (topics.ESTIMATES, topics.ESTIMATE_LABELS)
            )
        )
        self._watches = {joint: WatchPublisher(node, joint) for joint in joints}

    @property
    def listeners(self) -> int:
        """How many subscribers there are to every step."""
        return min(self._signals.listeners, self._estimates.listeners)

    def publish(
        self, loops: Mapping[str, ControlLoop], steps: Mapping[str, ControlStep],
    ) -> None:
        """Tell of the steps of a sample."""
        rows = [_rows(loop, steps.get(joint)) for joint, loop in loops.items()]
        self._signals.publish(_joined(signals for signals, _ in rows))
        self._estimates.publish(_joined(estimates for _, estimates in rows))
        now_s = time.monotonic()
        for joint, (signals, estimates) in zip(loops, rows, strict=True):
            if joint in steps:
                self._watches[joint].follow(signals, estimates, now_s)


def _rows(loop: ControlLoop, step: ControlStep | None) -> tuple[Row, Row]:
    """Signals and estimates of a joint."""
    if step is None:
        return (nan,) * len(topics.SIGNAL_LABELS), (nan,) * len(topics.ESTIMATE_LABELS)
    e, sample = step.estimate, float(loop.counter.index)
    estimator = loop.core.estimator
    return (
        step.y_m, step.y, step.u_d, step.v, estimator.u_hat, estimator.innovation,
        float(e.status), sample, loop.statistics.latencies[-1],
    ), (e.m, e.c_r, e.c_l, e.f, *stated_deviations(e), nan, sample)


def _joined(rows: Iterator[Row]) -> Row:
    return sum(rows, ())
