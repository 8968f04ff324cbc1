"""Node that judges a driver: it listens, moves it gently if told to, and says what does not fit."""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from math import inf
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller, build_limits
from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check.findings import (
    WRONG,
    Finding,
    Heard,
    Message,
    timing_of,
)
from backlash_ros.core.driver_check.gentle_drive import Drive, GentleDrive, Range, drive_range
from backlash_ros.core.driver_check.motion import record_of
from backlash_ros.core.driver_check.verdict import all_fit, judge, table
from backlash_ros.core.parameters.table import CONTROLLER
from backlash_ros.nodes.control.rivals import Presence, identity_made_by
from backlash_ros.nodes.driver_check.driver_graph import DriverGraph
from backlash_ros.nodes.driver_check.options import EXECUTABLE, parameter_files, parse_options
from backlash_ros.nodes.runtime.executor import NodeExecutor
from backlash_ros.nodes.runtime.messages import DEPTH
from backlash_ros.nodes.runtime.process import ProcessNode, ros_arguments, run
from backlash_ros.options import BAD_INPUT, DONE, FAILED
from backlash_ros.shipped import find_config

LOOK_S = 0.1  # between two looks at the graph
SETTLE_S = 1.0  # after which everybody should have found everybody
LAST_SENT = 10  # times that the last v is sent at most, until it is confirmed
CONFIRMED_WITHIN = Duration(nanoseconds=100_000_000)
REMIND_S = 3.0  # between two lines that say what is missing
UNSEEN = 'a controller of this machine'  # that discovery has not found yet


class CheckDriverNode(ProcessNode):
    """Stands in for the controller, with its parameters, and judges what it hears.

    Driving, it answers every plant_output with a control, as the controller does, and brings v
    to rest at the end, whatever ends it.
    """

    program = EXECUTABLE  # as messages name it

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(EXECUTABLE, parameters_of=CONTROLLER)
        build_controller(self.settings)
        self._options = options
        self._period = self.settings.sample_period
        self._limits = (
            drive_range(self.settings, options.amplitude, options.rate) if options.drive else None
        )
        self._drive: Drive | None = None
        self._driving = False
        self._heard = Heard()
        self._range_left: float | None = None
        self._rivals = ''  # who else publishes control
        self._silent_s = 0.0  # how long the driver was when it was given up, 0 where it was not
        self._heard_at = inf  # on the steady clock [s]
        self._names = {
            topic: self.resolve_topic_name(topic)
            for topic in (topics.PLANT_OUTPUT, topics.CONTROL, topics.APPLIED_CONTROL)
        }
        self._graph = DriverGraph(self, self._names)
        self.exit_code = FAILED

    def work(self, executor: NodeExecutor) -> None:
        """Wait for the driver, listen, come to rest, tell."""
        if self._await_driver(executor):
            self._listen()
            try:
                self._follow(executor)
            finally:
                self._come_to_rest()
        if self._rivals:
            print(
                f'{self.program}: {self._names[topics.CONTROL]} is published by {self._rivals}: '
                'stop that first, or leave --drive out', file=sys.stderr,
            )
            self.exit_code = BAD_INPUT
        else:
            self._tell()

    def _await_driver(self, executor: NodeExecutor) -> bool:
        deadline = time.monotonic() + self._options.wait
        remind = time.monotonic() + REMIND_S
        while not self.stopping:
            if self._graph.outputs():
                return True
            now = time.monotonic()
            if now > deadline:
                self._graph.say_what_is_missing()
                return False
            if now > remind:
                remind += REMIND_S
                self._graph.say_what_is_missing()
            executor.spin_once(timeout_sec=LOOK_S)
        return False

    def _listen(self) -> None:
        """Subscribe the way that hears the driver, whatever its QoS."""
        heard = self._heard
        self._hear(topics.APPLIED_CONTROL, heard.applied)
        if self._limits is None:
            self._hear(topics.CONTROL, heard.controls)
        else:
            own = identity_made_by(self, self._names[topics.CONTROL], self._advertise)
            self._presence = Presence(
                self.context.get_domain_id(), self._names[topics.CONTROL], own
            )
        self.listen(
            Float64, topics.PLANT_OUTPUT, self._on_output, self._graph.profile(topics.PLANT_OUTPUT)
        )

    def _advertise(self) -> Publisher:
        self._control: Publisher = self.create_publisher(Float64, topics.CONTROL, DEPTH)
        return self._control

    def _hear(self, topic: str, messages: list[Message]) -> None:
        def on_message(message: Float64, info: dict[str, Any]) -> None:
            messages.append(_message(message, info))

        self.listen(Float64, topic, on_message, self._graph.profile(topic))

    def _on_output(self, message: Float64, info: dict[str, Any]) -> None:
        if self._heard.end_ns:
            return  # it may follow from a v on its way to rest, which is not on record
        self._heard_at = time.monotonic()
        self._heard.outputs.append(_message(message, info))
        if not self._driving or self._limits is None or self._range_left is not None:
            return
        y = message.data
        low, high = self._options.output_range
        if plausible(y) and not low <= y <= high:
            self._range_left = y
            return
        if self._drive is None:
            self._drive = self._begin_drive(self._limits)
        self._command(self._drive.step())

    def _begin_drive(self, limits: Range) -> Drive:
        return GentleDrive(limits, self._period, self._options.duration, self._v_at_start())

    def _v_at_start(self) -> float:
        """The v that acts before the drive, 0 where nobody says it."""
        initial = self.settings.control.initial
        known = initial if plausible(initial) else None
        reported = [message.value for message in self._heard.applied[-1:]]
        if reported and plausible(reported[0]):
            return build_limits(self.settings).go_on_from(reported[0], known)
        if known is None:
            print(
                f'{self.program}: nobody says which v acts now, so the drive goes on from 0: '
                f'publish {topics.APPLIED_CONTROL}, or set control.initial', file=sys.stderr,
            )
        return known or 0.0

    def _command(self, v: float) -> None:
        now = time.time_ns()
        self._control.publish(Float64(data=v))
        self._heard.controls.append(Message(v, now, now, 0))

    def _follow(self, executor: NodeExecutor) -> None:
        """Listen for the duration, and drive."""
        begin = looked = time.monotonic()
        end = begin + self._options.duration + (0.0 if self._limits is None else SETTLE_S)
        patience = max(self.settings.timeout.plant_output, 10.0 * self._period)
        while not self.stopping:
            executor.spin_once(timeout_sec=LOOK_S)
            now = time.monotonic()
            if now > looked + LOOK_S:
                looked = now
                self._look_at_graph()
                self._driving = self._may_drive(now - begin)
            silent = self._driving and now > self._heard_at + patience
            self._silent_s = patience if silent else 0.0
            if now > end or silent or self._rivals or self._range_left is not None:
                break
        self._look_at_graph()
        self._driving = False
        self._heard.end_ns = time.time_ns()

    def _may_drive(self, listened_s: float) -> bool:
        """Whether to drive: told to, the graph known by now, heard by a driver, alone."""
        if self._limits is not None and listened_s > SETTLE_S and self._presence.others():
            self._rivals = self._rivals or UNSEEN
        return (
            self._limits is not None and listened_s > SETTLE_S and not self._rivals
            and self._control.get_subscription_count() > 0
        )

    def _come_to_rest(self) -> None:
        drive = self._drive
        if drive is None:
            return
        self._driving, before = False, self.signals
        deadline = time.monotonic() + self._options.rest
        while not drive.step_to_rest():
            self._control.publish(Float64(data=drive.v))
            time.sleep(self._period)
            late = time.monotonic() > deadline
            if late or self.signals > before:
                why = f'not at rest within --rest={self._options.rest:g} s' if late \
                    else 'another signal came'
                print(f'{self.program}: v is held at {drive.v:.6g}: {why}', file=sys.stderr)
                break
        # A busy machine may lose a message, and this one is to be heard before the node leaves.
        for _ in range(LAST_SENT):
            self._control.publish(Float64(data=drive.v))
            if self._control.wait_for_all_acked(CONFIRMED_WITHIN):
                return
        print(f'{self.program}: the driver has not confirmed the last v={drive.v:.6g}',
              file=sys.stderr)

    def _look_at_graph(self) -> None:
        if self._limits is not None:
            # Once heard, a rival counts, even if it leaves.
            self._rivals = self._rivals or self._graph.rivals()
        self._graph.look()

    def _tell(self) -> None:
        findings = judge(self._graph.in_the_end(), self._heard, self.settings)
        if self._range_left is not None:
            findings.append(Finding(
                'range', WRONG, f'y = {self._range_left:.4g} left --output-range: drive ended',
                'widen --output-range, or drive less: --amplitude, --rate, --duration',
            ))
        print(table(findings), flush=True)
        if self._options.save is not None:
            self._save(self._options.save)
        self.exit_code = DONE if all_fit(findings) else FAILED

    def _save(self, path: Path) -> None:
        timing = timing_of(self._heard, self._period)
        record = None if timing is None else record_of(self._heard, timing)
        if record is None:
            print(f'{self.program}: nothing to save in {path}: v and y were not both heard',
                  file=sys.stderr)
            return
        try:
            with path.open('w', newline='', encoding='utf-8') as file:
                writer = csv.writer(file)
                writer.writerow(('t', 'v', 'y'))
                for k, (v, y) in enumerate(zip(record.v, record.y, strict=True)):
                    writer.writerow((repr(k * self._period), repr(float(v)), repr(float(y))))
        except OSError as error:
            print(f'{self.program}: {path}: cannot be written: {error.strerror}', file=sys.stderr)
            return
        print(f'saved {len(record.v)} samples of v and y in {path}')


def _message(message: Float64, info: dict[str, Any]) -> Message:
    return Message(
        message.data, info['source_timestamp'], info['received_timestamp'],
        info['publication_sequence_number'],
    )


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if args is None else args
    options = parse_options(remove_ros_args(['', *arguments])[1:], __doc__)
    with tempfile.TemporaryDirectory() as folder:
        files = [] if options.config is None else parameter_files(
            str(find_config(Path(options.config))), Path(folder)
        )
        given = ['--ros-args'] if files else []
        for file in files:
            given += ['--params-file', file]
        return run(
            EXECUTABLE, lambda: CheckDriverNode(options), [*given, *ros_arguments(arguments)]
        )


if __name__ == '__main__':
    sys.exit(main())
