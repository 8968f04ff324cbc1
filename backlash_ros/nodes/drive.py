"""Node that stands in for the controller: it hears a driver, and moves v gently if told to.

As a process it is the part of `identify --drive` that moves an actuator, and records.
"""

import argparse
import sys
import time
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller, build_limits
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check import Heard, Message
from backlash_ros.core.identification.motion import Drive, Shape, drive_limits, strokes
from backlash_ros.core.parameters.table import CONTROLLER
from backlash_ros.nodes.control.rivals import CommandLock, name_of
from backlash_ros.nodes.driver_graph import DriverGraph
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.messages import DEPTH
from backlash_ros.nodes.runtime.process import ProcessNode, run, split_arguments
from backlash_ros.options import BAD_INPUT, DONE, FAILED, add_motion_options

LOOK_S = 0.1  # between two looks at the graph


class MotionNode(ProcessNode):
    """Hears a driver and, with --drive, answers every plant_output with a control.

    v is brought to rest at the end, whatever ends the motion. The parameters are those of the
    controller. motion: v on its way, None before the first one. ended: why the motion ended before
    its time, empty if it did not. names: full names of the topics.
    """

    def __init__(self, program: str, options: argparse.Namespace, shape: Shape) -> None:
        super().__init__(program, parameters_of=CONTROLLER)
        p = self.settings
        build_controller(p)
        self.options = options
        if options.drive:
            limits = drive_limits(p, options.amplitude, options.rate)
            self._begin = partial(Drive, shape, limits, p.sample_period, options.duration)
        self.heard = Heard()
        self.motion: Drive | None = None
        self.ended, self.exit_code = '', FAILED
        self.names = {topic: self.resolve_topic_name(topic) for topic in self.heard.by_topic}
        self.graph = DriverGraph(self, self.names)
        self._driving, self._rivals = False, ''
        self._lock = CommandLock(self.context.get_domain_id(), self.names[topics.CONTROL])
        self._control: Publisher

    def tell(self) -> None:
        """Say what came of it, and set the exit code."""

    def look(self) -> None:
        """Called every LOOK_S while the node listens."""
        if self.options.drive:
            # Once heard, a rival counts, even if it leaves.
            rivals = {name_of(info) for info in self.graph.publishers(topics.CONTROL)}
            self._rivals = self._rivals or ', '.join(sorted(rivals))
        self.graph.look()

    def say(self, text: str) -> None:
        print(f'{self.get_name()}: {text}', file=sys.stderr)

    def work(self, executor: PromptExecutor) -> None:
        if self._await_driver(executor):
            try:
                self._follow(executor)
            finally:
                self._come_to_rest()
        if self._rivals:
            self.say(f'{self.names[topics.CONTROL]} is published by {self._rivals}: stop that '
                     'first, or leave --drive out')
            self.exit_code = BAD_INPUT
        else:
            self.tell()

    def _await_driver(self, executor: PromptExecutor) -> bool:
        now = time.monotonic()
        deadline, remind = now + self.options.wait, now + 3.0
        while not self.stopping and not self.graph.publishers(topics.PLANT_OUTPUT):
            now = time.monotonic()
            if now > min(deadline, remind):
                self.graph.say_what_is_missing()
                remind += 3.0
            if now > deadline:
                return False
            executor.spin_once(timeout_sec=LOOK_S)
        return not self.stopping

    def _follow(self, executor: PromptExecutor) -> None:
        """Listen for the duration; drive for as many samples as it has, late ones as well."""
        settle_s = 1.0  # after which everybody should have found everybody
        driving, p = self.options.drive, self.settings
        self._hear(topics.APPLIED_CONTROL)
        if driving:
            self._control = self.create_publisher(Float64, topics.CONTROL, DEPTH)
        else:
            self._hear(topics.CONTROL)
        self._hear(topics.PLANT_OUTPUT)
        begin = looked = time.monotonic()
        enough = self.options.duration / p.sample_period if driving else inf
        end = begin + (2.0 * self.options.duration + settle_s if driving else self.options.duration)
        patience = max(p.timeout.plant_output, 10.0 * p.sample_period)
        outputs, newest = 0, inf  # y heard so far, and when that was seen
        while not (self.stopping or self.ended or self._rivals) \
                and len(self.heard.controls) < enough and time.monotonic() < end:
            executor.spin_once(timeout_sec=LOOK_S)
            now = time.monotonic()
            if len(self.heard.outputs) > outputs:
                outputs, newest = len(self.heard.outputs), now
            if now > looked + LOOK_S:
                looked = now
                self.look()
                if driving and now > begin + settle_s:
                    if not self._lock.take():
                        self._rivals = self._rivals or 'a controller of this machine'
                    self._driving = self._control.get_subscription_count() > 0
            if self._driving and now > newest + patience:
                self.ended = \
                    f'nothing was heard on {self.names[topics.PLANT_OUTPUT]} for {patience:g} s'
        self.look()
        self.heard.end_ns = time.time_ns()

    def _hear(self, topic: str) -> None:
        """Subscribe the way that hears whoever publishes, whatever the QoS."""
        def on_message(message: Float64, info: dict[str, Any]) -> None:
            self.heard.by_topic[topic].append(Message(
                message.data, info['source_timestamp'], info['received_timestamp'],
                info['publication_sequence_number']))
            if topic == topics.PLANT_OUTPUT and self._driving and not self._rivals:
                self._answer(message.data)

        self.listen(Float64, topic, on_message, self.graph.profile(topic))

    def _answer(self, y: float) -> None:
        """Move v on by a sample, unless the motion has ended."""
        low, high = self.options.output_range or (-inf, inf)
        if plausible(y) and not low <= y <= high:
            self.ended = self.ended or f'y = {y:.4g} left --output-range'
        if self.ended:
            return
        if self.motion is None:
            self.motion = self._begin(self._v_at_start())
        v, now = self.motion.step(), time.time_ns()
        self._control.publish(Float64(data=v))
        self.heard.controls.append(Message(v, now, now, 0))

    def _v_at_start(self) -> float:
        """The v that acts before the motion, 0 where nobody says it."""
        initial = self.settings.control.initial
        known = initial if plausible(initial) else None
        reported = [message.value for message in self.heard.applied[-1:]]
        if reported and plausible(reported[0]):
            return build_limits(self.settings).go_on_from(reported[0], known)
        if known is None:
            self.say('nobody says which v acts now, so the drive goes on from 0: publish '
                     f'{topics.APPLIED_CONTROL}, or set control.initial')
        return known or 0.0

    def _come_to_rest(self) -> None:
        if self.motion is None:
            return
        before, deadline = len(self.signals), time.monotonic() + self.options.rest
        v = self.heard.controls[-1].value
        for v in self.motion.to_rest():
            self._control.publish(Float64(data=v))
            time.sleep(self.settings.sample_period)
            late = time.monotonic() > deadline
            if late or len(self.signals) > before:
                why = f'not at rest within --rest={self.options.rest:g} s' if late \
                    else 'another signal came'
                self.say(f'v is held at {v:.6g}: {why}')
                break
        # A busy machine may lose a message, and this one is to be heard before the node leaves.
        for _ in range(10):
            self._control.publish(Float64(data=v))
            if self._control.wait_for_all_acked(Duration(seconds=0.1)):
                return
        self.say(f'the driver has not confirmed the last v={v:.6g}')


class IdentificationDriveNode(MotionNode):
    """Writes what it hears and sends as it goes: topic, time stamp [ns], value on each line."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__('identify', options, strokes)
        self._file = options.messages.open('w', encoding='ascii')
        self._written = dict.fromkeys(self.heard.by_topic, 0)

    def look(self) -> None:
        super().look()
        for topic, messages in self.heard.by_topic.items():
            for message in messages[self._written[topic]:]:
                print(topic, message.stamp_ns, repr(message.value), sep=',', file=self._file)
            self._written[topic] = len(messages)
        self._file.flush()

    def tell(self) -> None:
        if self.ended:
            self.say(f'{self.ended}: drive ended')
        if self.motion is None:
            why = f'nobody subscribes to {self.names[topics.CONTROL]}' if self.heard.outputs \
                else f'nothing was heard on {self.names[topics.PLANT_OUTPUT]}'
            self.say(f'the actuator was not moved: {why}')
        self.exit_code = FAILED if self.motion is None else DONE


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code. The options are those that `identify` has checked."""
    plain, of_ros = split_arguments(args)
    parser = argparse.ArgumentParser(prog='identify')
    parser.set_defaults(drive=True)
    parser.add_argument('--messages', type=Path, required=True)
    parser.add_argument('--config', required=True)
    add_motion_options(parser, 10.0, 'how long to listen')
    options = parser.parse_args(plain)
    return run('identify', lambda: IdentificationDriveNode(options),
               ['--ros-args', '--params-file', options.config, *of_ros])


if __name__ == '__main__':
    sys.exit(main())
