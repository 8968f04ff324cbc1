"""Node that judges a driver: it listens, moves it gently if told to, and says what does not fit.

For `identify --drive` it moves v, and writes what it hears and sends instead of judging it.
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
from backlash_ros.core.control.limits import Limits, plausible
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
    find_config,
)

LOOK_S = 0.1  # between two looks at the graph


class MessageLog:
    """All messages heard and sent; each is a line of a file as well where a path is given."""

    def __init__(self, path: str | None) -> None:
        self.heard = driver_check.Heard()
        # A line at a time, for `identify` reads it meanwhile.
        self._file = open(path or os.devnull, 'w', 1, encoding='ascii')  # noqa: SIM115

    def note(self, topic: str, message: driver_check.Message) -> None:
        self.heard.by_topic[topic].append(message)
        print(topic, message.stamp_ns, repr(message.value), sep=',', file=self._file)


class ActuatorDrive:
    """Moves v: a control for every plant_output, from the v that acts, and to rest at the end.

    It waits until everybody has found everybody and somebody listens. rivals: who else moves v.
    ended: why the motion ended before its time.
    """

    def __init__(
        self, node: ProcessNode, options: argparse.Namespace, limits: Limits, messages: MessageLog,
    ) -> None:
        self._node, self._options, self._limits, self._messages = node, options, limits, messages
        self._motion: Drive | None = None  # v on its way
        self._control = node.create_publisher(Float64, topics.CONTROL, DEPTH)
        self._lock = CommandLock(
            node.context.get_domain_id(), node.resolve_topic_name(topics.CONTROL))
        self._settled_at = time.monotonic() + 1.0  # everybody found everybody
        self._newest_at = inf  # the newest y came
        self._answers = False
        self.ended = self.rivals = ''

    @property
    def over(self) -> bool:
        """Whether v has had all the samples of the duration, late ones as well, or gets no more."""
        duration_s = self._options.duration
        enough = duration_s / self._node.settings.sample_period
        return bool(self.ended or self.rivals) or len(self._messages.heard.controls) >= enough \
            or time.monotonic() > self._settled_at + 2.0 * duration_s

    def look(self) -> None:
        """Take note of who else is there. Once heard, a rival counts, even if it leaves."""
        rivals = {name_of(info) for info in publishers(self._node, topics.CONTROL)}
        now, p = time.monotonic(), self._node.settings
        if now > self._settled_at:
            if not self._lock.take():
                rivals = rivals or {'a controller of this machine'}
            self._answers = self._control.get_subscription_count() > 0
        self.rivals = self.rivals or ', '.join(sorted(rivals))
        patience_s = max(p.timeout.plant_output, 10.0 * p.sample_period)
        if self._answers and now > self._newest_at + patience_s:
            output = self._node.resolve_topic_name(topics.PLANT_OUTPUT)
            self.ended = f'nothing was heard on {output} for {patience_s:g} s'

    def answer(self, y: float) -> None:
        """Move v on by a sample, unless it has to wait or the motion has ended."""
        self._newest_at = time.monotonic()
        if self.rivals or not self._answers:
            return
        low, high = self._options.output_range or (-inf, inf)
        if plausible(y) and not low <= y <= high:
            self.ended = self.ended or f'y = {y:.4g} left --output-range'
        if self.ended:
            return
        if self._motion is None:
            self._motion = Drive(self._limits, self._node.settings.sample_period,
                                 self._options.duration, self._v_at_start())
        v, now = self._motion.step(), time.time_ns()
        self._control.publish(Float64(data=v))
        self._messages.note(topics.CONTROL, driver_check.Message(v, now, now, 0))

    def _v_at_start(self) -> float:
        """The v that acts before the motion, 0 where nobody says it."""
        p = self._node.settings
        known = p.control.initial if plausible(p.control.initial) else None
        for message in self._messages.heard.applied[-1:]:
            if plausible(message.value):
                return build_limits(p).go_on_from(message.value, known)
        if known is None:
            say(self._node, 'nobody says which v acts now, so the drive goes on from 0: publish '
                f'{topics.APPLIED_CONTROL}, or set control.initial')
        return known or 0.0

    def come_to_rest(self) -> None:
        """Bring v to rest, or hold it where that takes too long or another signal comes."""
        if self._motion is None:
            return
        node, rest_s = self._node, self._options.rest
        before, deadline = len(node.signals), time.monotonic() + rest_s
        v = self._messages.heard.controls[-1].value
        for v in self._motion.to_rest():
            self._control.publish(Float64(data=v))
            time.sleep(node.settings.sample_period)
            late = time.monotonic() > deadline
            if late or len(node.signals) > before:
                why = f'not at rest within --rest={rest_s:g} s' if late \
                    else 'another signal came'
                say(node, f'v is held at {v:.6g}: {why}')
                break
        # A busy machine may lose a message, and this one is to be heard before the node leaves.
        for _ in range(10):
            self._control.publish(Float64(data=v))
            if self._control.wait_for_all_acked(Duration(seconds=0.1)):
                return
        say(node, f'the driver has not confirmed the last v={v:.6g}')


class CheckDriverNode(ProcessNode):
    """Hears a driver and, with --drive, answers every plant_output with a control.

    v is brought to rest at the end, whatever ends the motion. The parameters are those of the
    controller.
    """

    def __init__(self, program: str, options: argparse.Namespace) -> None:
        super().__init__(program, parameters_of=CONTROLLER)
        p = self.settings
        build_controller(p)
        self._options = options
        self._limits = drive_limits(p, options.amplitude, options.rate) if options.drive else None
        self._drive: ActuatorDrive | None = None  # once the driver is found
        self._messages = MessageLog(options.messages)
        self._graph = driver_check.Graph()  # with the most of them that were there at once

    def work(self, executor: PromptExecutor) -> None:
        if self._finds_driver(executor):
            try:
                self._follow(executor)
            finally:
                if self._drive is not None:
                    self._drive.come_to_rest()
        self.exit_code = self._tell()

    def _finds_driver(self, executor: PromptExecutor) -> bool:
        reminder = self.every(3.0, lambda: say_what_is_missing(self))
        deadline, found = time.monotonic() + self._options.wait, False
        while not (found or self.stopping or time.monotonic() > deadline):
            executor.spin_once(timeout_sec=LOOK_S)
            found = bool(publishers(self, topics.PLANT_OUTPUT))
        self.destroy_timer(reminder)
        return found and not self.stopping

    def _follow(self, executor: PromptExecutor) -> None:
        """Listen for the duration, or until the drive is over."""
        self._hear(topics.APPLIED_CONTROL)
        if self._limits is not None:
            self._drive = ActuatorDrive(self, self._options, self._limits, self._messages)
        else:
            self._hear(topics.CONTROL)
        self._hear(topics.PLANT_OUTPUT)
        end = time.monotonic() + self._options.duration
        self.every(LOOK_S, self._look)
        while not (self.stopping or (self._drive.over if self._drive else time.monotonic() > end)):
            executor.spin_once(timeout_sec=LOOK_S)
        self._look()
        self._messages.heard.end_ns = time.time_ns()

    def _look(self) -> None:
        """Take note of who is there."""
        self._graph = max(graph_around(self), self._graph,
                          key=lambda graph: (graph.publishers, graph.listeners))
        if self._drive is not None:
            self._drive.look()

    def _hear(self, topic: str) -> None:
        """Subscribe the way that hears whoever publishes, whatever the QoS."""
        def on_message(message: Float64, info: dict[str, Any]) -> None:
            if topic == topics.PLANT_OUTPUT and self._drive is not None:
                self._drive.answer(message.data)
            self._messages.note(topic, driver_check.Message(
                message.data, info['source_timestamp'], info['received_timestamp'],
                info['publication_sequence_number']))

        self.listen(Float64, topic, on_message, profile(self, topic))

    def _tell(self) -> int:
        """Say what came of it; returns the exit code."""
        drive, options = self._drive, self._options
        control = self.resolve_topic_name(topics.CONTROL)
        if drive is not None and drive.rivals:
            say(self, f'{control} is published by {drive.rivals}: stop that first, '
                'or leave --drive out')
            return BAD_INPUT
        ended = '' if drive is None else drive.ended
        if options.messages:
            if ended:
                say(self, f'{ended}: drive ended')
            if drive is not None and self._messages.heard.controls:
                return DONE
            why = f'nobody subscribes to {control}' if self._messages.heard.outputs else \
                f'nothing was heard on {self.resolve_topic_name(topics.PLANT_OUTPUT)}'
            say(self, f'the actuator was not moved: {why}')
            return FAILED
        findings = driver_check.judge(self._graph, self._messages.heard, self.settings)
        if ended:
            findings.append(driver_check.Judgement(
                'drive', driver_check.WRONG, f'{ended}: drive ended',
                'let y come all the time; widen --output-range, or drive less: --amplitude, --rate',
            ))
        print(driver_check.table(findings), flush=True)
        if options.save is not None:
            self._save(options.save)
        return DONE if driver_check.all_fit(findings) else FAILED

    def _save(self, path: Path) -> None:
        period = self.settings.sample_period
        record = driver_check.timing_of(self._messages.heard, period).record
        if record is None:
            say(self, f'nothing to save in {path}: v and y were not both heard')
            return
        rows = np.column_stack([period * np.arange(len(record[0])), *record])
        try:
            np.savetxt(path, rows, '%.12g', ',', header='t,v,y', comments='')
            print(f'saved {len(rows)} samples of v and y in {path}')
        except OSError as error:
            say(self, f'{path}: cannot be written: {error.strerror}')


def say(node: Node, text: str) -> None:
    print(f'{node.get_name()}: {text}', file=sys.stderr)


def publishers(node: Node, topic: str) -> list[TopicEndpointInfo]:
    """Who else publishes a topic."""
    return [info for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
            if info.node_name != node.get_name()]


def profile(node: Node, topic: str) -> QoSProfile:
    """The QoS that hears whoever publishes a topic."""
    return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT if
                      _has_best_effort(publishers(node, topic)) else ReliabilityPolicy.RELIABLE)


def graph_around(node: Node) -> driver_check.Graph:
    """Who is there now and, where nobody listens to v, which topics may have been meant for it."""
    control = node.resolve_topic_name(topics.CONTROL)
    outputs = publishers(node, topics.PLANT_OUTPUT)
    listeners = _others(node, node.get_subscriptions_info_by_topic(control))
    return driver_check.Graph(
        len(outputs), tuple(sorted({info.topic_type for info in outputs})), len(listeners),
        tuple(sorted({_misfit(info.qos_profile) for info in listeners} - {''})),
        _has_best_effort(outputs), () if listeners else
        similar_topics(control, _topics(node, node.get_subscriptions_info_by_topic)))


def say_what_is_missing(node: Node) -> None:
    """Say which topic is waited for, and which ones there are."""
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


def parse_options(plain: Sequence[str]) -> argparse.Namespace:
    parser = OptionParser('check_driver', description=__doc__,
                          epilog='Exit codes: 0 all fits, 1 something does not, 2 bad input.')
    parser.add_argument('--config', metavar='FILE', help='ROS 2 parameter file of the controller, '
                        'or the name of a shipped one')
    parser.add_argument('--drive', action='store_true', help='move v, to and fro within '
                        'the limits of control, to rest at the end')
    parser.add_argument('--save', type=Path, metavar='FILE', help='write t,v,y as CSV')
    # Of `identify`: a line for each message, with topic, time stamp [ns] and value.
    parser.add_argument('--messages', help=argparse.SUPPRESS)
    add_motion_options(parser, 10.0, 'how long to listen')
    options = parser.parse_args(plain)
    for name in ('amplitude', 'rate'):
        if getattr(options, name) is not None and not options.drive:
            parser.error(f'--{name} says how to drive: give --drive as well')
    return options


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    plain, given = split_arguments(args)
    options = parse_options(plain)
    program = 'identify' if options.messages else 'check_driver'
    with tempfile.TemporaryDirectory() as folder:
        if options.config is not None:
            config = find_config(Path(options.config))
            meant = Path(folder) / config.name
            # Sections for the controller are for this node. What is broken, rcl says of the file.
            with suppress(OSError):
                meant.write_bytes(re.sub(rb'(?m)^(\S*)\bcontroller(?=["\']?:)',
                                         rb'\1' + program.encode(), config.read_bytes()))
            for file in (meant, config):
                given = ['--ros-args', '--params-file', str(file), *given]
        return run(program, lambda: CheckDriverNode(program, options), given)


if __name__ == '__main__':
    sys.exit(main())
