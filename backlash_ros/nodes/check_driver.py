"""Judge a driver: listen, move v gently if --drive is given, and report what does not fit.

For `identify --drive`, move v and write all messages to a file instead of judging them.
"""

import argparse
import difflib
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core import driver_check
from backlash_ros.core.assembly import build_controller, build_limits
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.control.motion import Drive, drive_limits
from backlash_ros.core.parameters.table import CONTROLLER, RECORDER
from backlash_ros.nodes.control.rivals import CommandLock
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.messages import DEPTH, name_of
from backlash_ros.nodes.runtime.process import ProcessNode, run, split_arguments
from backlash_ros.options import (
    BAD_INPUT,
    DONE,
    FAILED,
    OptionParser,
    add_motion_options,
    check_motion_options,
    find_config,
)

LOOK_S = 0.1  # between two looks at the graph


class CheckDriverNode(ProcessNode):
    """Listens to a driver and reports what does not fit, with the parameters of the controller.

    ended: why listening stopped early, '' if it did not.
    """

    ended = ''

    def __init__(self, program: str, options: argparse.Namespace) -> None:
        super().__init__(program, parameters_of=CONTROLLER)
        build_controller(self.settings)
        self.options, self.heard = options, driver_check.Heard()
        self._graph = driver_check.Graph()  # the newest with the most publishers, listeners
        # Flushed after each line, as `identify` reads the file meanwhile.
        self._file = open(options.messages or os.devnull, 'w', 1, encoding='ascii')  # noqa: SIM115

    def work(self, executor: PromptExecutor) -> None:
        reminder = self.every(3.0, lambda: say_what_is_missing(self))
        deadline, found = time.monotonic() + self.options.wait, False
        while not (found or self.stopping or time.monotonic() > deadline):
            executor.spin_once(timeout_sec=LOOK_S)
            found = bool(publishers(self, topics.PLANT_OUTPUT))
        self.destroy_timer(reminder)
        if found and not self.stopping:
            self.follow(executor)
        self.exit_code = self.tell()

    def follow(self, executor: PromptExecutor) -> None:
        """Listen for the duration."""
        for topic in (topics.APPLIED_CONTROL, topics.CONTROL, topics.PLANT_OUTPUT):
            self.hear(topic)
        end = time.monotonic() + self.options.duration
        self.listen_until(lambda: time.monotonic() > end, executor)

    def hear(self, topic: str, answer: Callable[[float], None] = lambda value: None) -> None:
        """Subscribe so that all publishers are heard, whatever their QoS."""
        def on_message(message: Float64, info: dict[str, Any]) -> None:
            answer(message.data)
            self.note(topic, driver_check.Message(
                message.data, info['source_timestamp'], info['received_timestamp'],
                info['publication_sequence_number']))

        self.listen(Float64, topic, on_message, QoSProfile(depth=DEPTH, reliability=(
            ReliabilityPolicy.BEST_EFFORT if _has_best_effort(publishers(self, topic))
            else ReliabilityPolicy.RELIABLE)))

    def note(self, topic: str, message: driver_check.Message) -> None:
        self.heard.by_topic[topic].append(message)
        print(topic, message.stamp_ns, repr(message.value), sep=',', file=self._file)

    def listen_until(self, over: Callable[[], bool], executor: PromptExecutor) -> None:
        self.every(LOOK_S, self.look)
        while not (self.stopping or over()):
            executor.spin_once(timeout_sec=LOOK_S)
        self.look()
        self.heard.end_ns = time.time_ns()

    def look(self) -> None:
        """Update the graph of publishers and subscribers."""
        self._graph = max(graph_around(self), self._graph,
                          key=lambda graph: (graph.publishers, graph.listeners))

    def tell(self) -> int:
        """Print the findings; returns the exit code."""
        findings = driver_check.judge(self._graph, self.heard, self.settings)
        if self.ended:
            findings.append(driver_check.Judgement(
                'drive', driver_check.WRONG, f'{self.ended}: drive ended',
                'publish y without pause; widen --output-range, or drive less: --amplitude, --rate',
            ))
        print(driver_check.table(findings), flush=True)
        saved = self.options.save is None or self._save(self.options.save)
        return DONE if saved and driver_check.all_fit(findings) else FAILED

    def say(self, text: str) -> None:
        print(f'{self.get_name()}: {text}', file=sys.stderr)

    def _save(self, path: Path) -> bool:
        period = self.settings.sample_period
        record = driver_check.timing_of(self.heard, period).record
        if record is None:
            self.say(f'nothing to save in {path}: v and y were not both heard')
            return False
        rows = np.column_stack([period * np.arange(len(record[0])), *record])
        try:
            np.savetxt(path, rows, '%.12g', ',', header='t,v,y', comments='')
        except OSError as error:
            self.say(f'{path}: cannot be written: {error.strerror}')
            return False
        print(f'saved {len(rows)} samples of v and y in {path}')
        return True


class DriveNode(CheckDriverNode):
    """Moves v as well: one control for each plant_output, from the v that acts, to rest at the end.

    It waits for discovery and for a subscriber of control. Whatever ends the motion, v is brought
    to rest. rivals: other publishers of control.
    """

    def __init__(self, program: str, options: argparse.Namespace) -> None:
        super().__init__(program, options)
        self._limits = drive_limits(self.settings, options.amplitude, options.rate)
        self._motion: Drive | None = None  # once v moves
        self._newest_at = inf  # when the newest y came
        self._answers = False
        self.rivals = ''

    def follow(self, executor: PromptExecutor) -> None:
        """Listen until v has moved for all samples of the duration, or for twice the duration."""
        self.hear(topics.APPLIED_CONTROL)
        self._control = self.create_publisher(Float64, topics.CONTROL, DEPTH)
        self._lock = CommandLock(
            self.context.get_domain_id(), self.resolve_topic_name(topics.CONTROL))
        self._settled_at = time.monotonic() + 1.0  # discovery has ended
        self.hear(topics.PLANT_OUTPUT, self._answer)
        duration_s = self.options.duration
        enough = duration_s / self.settings.sample_period
        try:
            self.listen_until(
                lambda: bool(self.ended or self.rivals) or len(self.heard.controls) >= enough
                or time.monotonic() > self._settled_at + 2.0 * duration_s, executor)
        finally:
            self._come_to_rest()

    def look(self) -> None:
        """Look for listeners and rivals as well. A rival counts even if it has left again."""
        super().look()
        rivals = {name_of(info) for info in publishers(self, topics.CONTROL)}
        now, p = time.monotonic(), self.settings
        if now > self._settled_at:
            if not self._lock.take():
                rivals = rivals or {'a controller of this machine'}
            self._answers = self._control.get_subscription_count() > 0
        self.rivals = self.rivals or ', '.join(sorted(rivals))
        patience_s = max(p.timeout.plant_output, 10.0 * p.sample_period)
        if self._answers and now > self._newest_at + patience_s:
            output = self.resolve_topic_name(topics.PLANT_OUTPUT)
            self.ended = f'nothing was heard on {output} for {patience_s:g} s'

    def tell(self) -> int:
        control = self.resolve_topic_name(topics.CONTROL)
        if self.rivals:
            self.say(f'{control} is published by {self.rivals}: stop that first, '
                     'or leave --drive out')
            return FAILED if self.heard.controls else BAD_INPUT
        if not self.options.messages:
            return super().tell()
        if self.ended:
            self.say(f'{self.ended}: drive ended')
        if self.heard.controls:
            return DONE
        why = f'nobody subscribes to {control}' if self.heard.outputs else \
            f'nothing was heard on {self.resolve_topic_name(topics.PLANT_OUTPUT)}'
        self.say(f'the actuator was not moved: {why}')
        return FAILED

    def _answer(self, y: float) -> None:
        """Answer y with the next v, unless the motion has to wait or has ended."""
        self._newest_at = time.monotonic()
        if self.rivals or not self._answers:
            return
        low, high = self.options.output_range or (-inf, inf)
        if plausible(y) and not low <= y <= high:
            self.ended = self.ended or f'y = {y:.4g} left --output-range'
        if self.ended:
            return
        if self._motion is None:
            self._motion = Drive(self._limits, self.settings.sample_period, self.options.duration,
                                 self._v_at_start())
        v, now = self._motion.step(), time.time_ns()
        self._control.publish(Float64(data=v))
        self.note(topics.CONTROL, driver_check.Message(v, now, now, 0))

    def _v_at_start(self) -> float:
        """The v that acts before the motion, 0 if nothing tells it."""
        p = self.settings
        known = p.control.initial if plausible(p.control.initial) else None
        for message in self.heard.applied[-1:]:
            if plausible(message.value):
                return build_limits(p).go_on_from(message.value, known)
        if known is None:
            self.say('nobody says which v acts now, so the drive goes on from 0: publish '
                     f'{topics.APPLIED_CONTROL}, or set control.initial')
        return known or 0.0

    def _come_to_rest(self) -> None:
        """Bring v to rest, or hold it if that takes too long or another signal comes."""
        if self._motion is None:
            return
        before, deadline = len(self.signals), time.monotonic() + self.options.rest
        v = self.heard.controls[-1].value
        for v in self._motion.to_rest():
            self._control.publish(Float64(data=v))
            time.sleep(self.settings.sample_period)
            late = time.monotonic() > deadline
            if late or len(self.signals) > before:
                why = f'not at rest within --rest={self.options.rest:g} s' if late \
                    else 'another signal came'
                self.say(f'v is held at {v:.6g}: {why}')
                break
        else:
            self.say(f'v is at rest at {v:.6g}')
        # A busy machine may lose a message, but the driver must get this one before the node ends.
        for _ in range(10):
            self._control.publish(Float64(data=v))
            if self._control.wait_for_all_acked(Duration(seconds=0.1)):
                return
        self.say(f'the driver has not confirmed the last v={v:.6g}')


def publishers(node: Node, topic: str) -> list[TopicEndpointInfo]:
    """The publishers of a topic other than this node."""
    return [info for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            if info.node_name != node.get_name()]


def graph_around(node: Node) -> driver_check.Graph:
    """The present graph and, if nobody listens to v, topics that may be meant to be control."""
    control = node.resolve_topic_name(topics.CONTROL)
    outputs = publishers(node, topics.PLANT_OUTPUT)
    listeners = _others(node, node.get_subscriptions_info_by_topic(control))
    return driver_check.Graph(
        len(outputs), tuple(sorted({info.topic_type for info in outputs})), len(listeners),
        tuple(sorted({_misfit(info.qos_profile) for info in listeners} - {''})),
        _has_best_effort(outputs), () if listeners else
        similar_topics(control, _topics(node, node.get_subscriptions_info_by_topic)))


def say_what_is_missing(node: Node) -> None:
    """Print which topic is waited for, and which topics there are."""
    wanted = node.resolve_topic_name(topics.PLANT_OUTPUT)
    seen = _topics(node, node.get_publishers_info_by_topic)
    others = ', '.join(sorted(seen)) or 'no topic'
    print(f'waiting for {wanted} ({driver_check.FLOAT64}), sees {others}', *(
        f'  if {near} ({", ".join(seen[near])}) is it: '
        f'--ros-args -r {topics.PLANT_OUTPUT}:={near}' for near in similar_topics(wanted, seen)
    ), sep='\n', flush=True)


def _topics(
    node: Node, endpoints: Callable[[str], list[TopicEndpointInfo]],
) -> dict[str, list[str]]:
    """Topics with such endpoints of other nodes, and their types, but for those of ROS itself."""
    return {topic: types for topic, types in node.get_topic_names_and_types()
            if topic not in ('/rosout', '/parameter_events') and _others(node, endpoints(topic))}


def _others(node: Node, endpoints: Sequence[TopicEndpointInfo]) -> list[TopicEndpointInfo]:
    """The endpoints without those of this node, of the recorder and of `ros2 topic`."""
    return [info for info in endpoints if info.node_name not in (node.get_name(), RECORDER)
            and not info.node_name.startswith('_ros2cli')]


def _has_best_effort(endpoints: Sequence[TopicEndpointInfo]) -> bool:
    return any(info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in endpoints)


def _misfit(asked: QoSProfile) -> str:
    """Why messages cannot pass from control to a subscriber, empty if they can."""
    # Discovery does not tell the depth and tells "infinite" durations, which would not fit.
    bare = QoSProfile(depth=DEPTH, reliability=asked.reliability, durability=asked.durability)
    compatibility, reason = qos_check_compatible(QoSProfile(depth=DEPTH), bare)
    return f'control: {reason}' if compatibility == QoSCompatibility.ERROR else ''


def similar_topics(wanted: str, seen: Iterable[str]) -> tuple[str, ...]:
    """Topics whose last name is similar to that of the wanted one."""
    last = wanted.rpartition('/')[2]
    return tuple(topic for topic in sorted(seen) if topic != wanted and
                 difflib.SequenceMatcher(None, last, topic.rpartition('/')[2]).ratio() >= 0.6)


def parse_options(plain: Sequence[str]) -> argparse.Namespace:
    parser = OptionParser('check_driver', description=__doc__,
                          epilog='Exit codes: 0 all fits, 1 something does not, 2 bad input.')
    parser.add_argument('--config', metavar='FILE', help='ROS 2 parameter file of the controller, '
                        'or the name of a shipped one')
    parser.add_argument('--drive', action='store_true', help='move v, to and fro within '
                        'the limits of control, and end at rest')
    parser.add_argument('--save', type=Path, metavar='FILE', help='write t,v,y as CSV')
    # For `identify`: a line for each message, with topic, time stamp [ns] and value.
    parser.add_argument('--messages', help=argparse.SUPPRESS)
    add_motion_options(parser, 10.0, 'how long to listen')
    options = parser.parse_args(plain)
    check_motion_options(parser, options)
    return options


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    plain, given = split_arguments(args)
    options = parse_options(plain)
    program = 'identify' if options.messages else 'check_driver'
    node = DriveNode if options.drive else CheckDriverNode
    with tempfile.TemporaryDirectory() as folder:
        if options.config is not None:
            config = find_config(Path(options.config))
            meant = Path(folder) / config.name
            # Sections for the controller are for this node. rcl reports errors in the file itself.
            with suppress(OSError):
                meant.write_bytes(re.sub(rb'(?m)^(\S*)\bcontroller(?=["\']?:)',
                                         rb'\1' + program.encode(), config.read_bytes()))
            for file in (meant, config):
                given = ['--ros-args', '--params-file', str(file), *given]
        return run(program, lambda: node(program, options), given)


if __name__ == '__main__':
    sys.exit(main())
