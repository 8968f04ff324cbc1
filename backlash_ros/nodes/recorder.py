"""Node that records all topics of the loop to a bag and tells how the run is going."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosbags.interfaces import Connection
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.bags.reader import REPAIR_COMMAND
from backlash_ros.bags.repair import repair_command
from backlash_ros.bags.writer import Bag, RecordingError
from backlash_ros.core.loop.finding import Finding, Level
from backlash_ros.core.loop.sample_counter import UNNUMBERED
from backlash_ros.core.parameters.table import RECORDER
from backlash_ros.nodes.runtime.driver_io import driver_topics, output_qos
from backlash_ros.nodes.runtime.executor import NodeExecutor
from backlash_ros.nodes.runtime.messages import (
    DIAGNOSTICS_PERIOD_S,
    KEPT_QOS,
    DiagnosticsPublisher,
    stamp_ns_of,
)
from backlash_ros.nodes.runtime.process import ENABLED, ProcessNode, emit, run
from backlash_ros.options import BAD_INPUT, FAILED

RECORDER_DEPTH = 10_000  # messages that may wait while the disk is slow
FLUSH_PERIOD_S = 0.4  # what a crash or a power cut may cost, with the time that a flush takes
# Longest time to take in what has arrived before the bag is closed: a signal ends it in a second.
DRAIN_S = 0.3
IDLE_SPINS = 5  # without a message, timers being served in between
# All but those that io.style names; y comes last of all: it starts the loop.
OF_THE_LOOP: dict[str, type[Any]] = {
    topics.ESTIMATES: Float64MultiArray, topics.SIGNALS: Float64MultiArray,
    topics.MODEL: Float64MultiArray, topics.TRUTH: Float64MultiArray,
    topics.DIAGNOSTICS: DiagnosticArray,
}
NEEDED_PUBLISHERS = (topics.ESTIMATES, topics.SIGNALS)


@dataclass
class Channel:
    """A recorded topic: what came in, and how many messages were missed on the way."""

    topic: str
    several_publishers: bool
    name: str = ''  # with namespace and remappings, as it is recorded
    connection: Connection | None = None
    received: int = 0
    recorded: int = 0
    missed: int = 0
    sequence: int = UNNUMBERED

    def count(self, sequence: int) -> None:
        """Take note of a message."""
        self.received += 1
        if sequence == UNNUMBERED or self.several_publishers:
            return
        if self.sequence != UNNUMBERED and sequence > self.sequence + 1:
            self.missed += sequence - self.sequence - 1
        self.sequence = sequence


class Progress:
    """The newest rows, still serialised, and what they say of the run (of its first joint)."""

    def __init__(self) -> None:
        self._estimates = b''
        self._truth = b''
        # The truth of a sample follows its signals by one sample.
        self._signals: deque[bytes] = deque(maxlen=8)
        self._first = b''
        self._rows = 0

    def take(self, topic: str, message: bytes) -> None:
        """Remember a row of one of the array topics."""
        if topic == topics.ESTIMATES:
            self._estimates = message
        elif topic == topics.TRUTH:
            self._truth = message
        elif topic == topics.SIGNALS:
            self._first = self._first or message
            self._signals.append(message)
            self._rows += 1

    def report(self) -> dict[str, object]:
        """Content of a progress event, empty before the first sample."""
        if not (self._estimates and self._signals):
            return {}
        signals = [_row(message, topics.SIGNAL_LABELS) for message in self._signals]
        first, newest = _row(self._first, topics.SIGNAL_LABELS), signals[-1]
        estimates = _row(self._estimates, topics.ESTIMATE_LABELS)
        truth = _row(self._truth, topics.TRUTH_LABELS) if self._truth else {}
        same = [row for row in signals if row['sample'] == truth.get('sample')]
        return {
            'sample': int(min(newest['sample'], estimates['sample'])),
            'status': int(newest['status']),
            **{name: estimates[name] for name in (
                'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l',
            )},
            **{f'true_{name}': truth.get(name) for name in ('m', 'c_r', 'c_l')},
            'control_error': truth['u'] - same[0]['u_d'] if same else None,
            'lost': int(newest['sample'] - first['sample']) + 1 - self._rows,
        }


def _row(message: bytes, labels: tuple[str, ...]) -> dict[str, float]:
    return dict(zip(labels, deserialize_message(message, Float64MultiArray).data, strict=False))


class RecorderNode(ProcessNode):
    """Writes messages as they came, stamped with the time at which they left their node.

    In lockstep the stamp is the simulated time. Without a bag it only tells the progress, which
    is also what it goes on with when the disk takes no more.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        p = self.settings
        self._lockstep = p.lockstep
        self._now_ns = 0  # simulated time
        self._bag: Bag | None = None
        self._diagnostics: DiagnosticsPublisher | None = None
        self.failure = ''  # why the recording has stopped before its time
        self._channels: list[Channel] = []
        self._progress = Progress()
        if p.bag:
            self._open_bag(p.bag, p.storage)
            self.log.info(f'started: records to {p.bag} ({p.storage})')
        else:
            self.log.info('started: nothing is recorded, as the parameter bag names no folder')
        needed: list[Callable[[], bool]] = []
        self._driver = to = driver_topics(p)
        # Lockstep promises every row: that of the first truth leaves as soon as y is subscribed to.
        truth = (topics.TRUTH,) if self._lockstep else ()
        wanted = (*NEEDED_PUBLISHERS, *truth, to.reference, to.control)
        recorded = {
            **OF_THE_LOOP, to.reference: to.reference_type, to.applied: to.applied_type,
            to.control: to.control_type,
        }
        for topic, message_type in recorded.items():
            # A G that was learned before this recorder came belongs into the bag as well.
            qos: QoSProfile | int = KEPT_QOS if topic == topics.MODEL else RECORDER_DEPTH
            subscription = self._record(topic, message_type, qos)
            if p.wait_for_publishers and topic in wanted:
                needed.append(subscription)
        if self._lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, RECORDER_DEPTH)
        if ENABLED:
            self.create_timer(0.2, self._tell, clock=self.steady_clock)
        self.call_when(
            lambda: all(heard() for heard in needed), self._start, ', '.join(wanted)
        )

    def work(self, executor: NodeExecutor) -> None:
        super().work(executor)
        # What has arrived belongs into the bag.
        deadline = time.monotonic() + DRAIN_S
        idle = 0
        while idle < IDLE_SPINS and time.monotonic() < deadline:
            received = self._received
            executor.spin_once(timeout_sec=0.0)
            idle = idle + 1 if received == self._received else 0

    def finish(self) -> None:
        bag = self._bag
        if self._with_bag(Bag.close) and bag is not None:
            self.log.info(
                f'recorded {bag.saved} messages of {bag.saved_ns * 1e-9:.1f} s to {bag.path}'
            )
        for channel in self._channels:
            if channel.missed:
                self.log.warning(f'{channel.missed} messages of {channel.name} were missed')
        if self.failure:
            unrecorded = self._received - sum(channel.recorded for channel in self._channels)
            self.log.warning(f'{unrecorded} messages came after the recording had stopped')
        emit(
            'closed', messages={channel.name: channel.recorded for channel in self._channels},
            missed=sum(channel.missed for channel in self._channels), failure=self.failure,
        )

    @property
    def _received(self) -> int:
        return sum(channel.received for channel in self._channels)

    def _open_bag(self, path: str, storage: str) -> None:
        self._bag = Bag(path, storage)
        if not self._bag.survives_a_crash:
            self.log.warning(
                'the installed version of rosbags cannot be flushed: a crash of the recorder or a '
                'power cut loses everything. Install the version that requirements/run.txt names'
            )
        self._diagnostics = DiagnosticsPublisher(self, path, logs=False)
        self.create_timer(
            FLUSH_PERIOD_S, lambda: self._with_bag(Bag.flush), clock=self.steady_clock
        )
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=self.steady_clock)

    def _with_bag(self, action: Callable[[Bag], None]) -> bool:
        """Do something with the bag; returns whether there is one and it went well."""
        bag = self._bag
        if bag is None:
            return False
        try:
            action(bag)
        except RecordingError as error:
            self._bag = None
            self.failure = (
                f'recording to {bag.path} stopped: {error}; saved are {bag.saved} messages of '
                f'{bag.saved_ns * 1e-9:.1f} s; all else goes on. Make room, then: '
                f'{REPAIR_COMMAND} {bag.path}'
            )
            self.exit_code = FAILED
            self.log.error(self.failure)
            emit('recording_stopped', reason=self.failure)
            self._diagnose()
            return False
        return True

    def _record(
        self, topic: str, message_type: type[Any], qos: QoSProfile | int,
    ) -> Callable[[], bool]:
        """Record a topic; return what says whether somebody publishes it."""
        channel = Channel(topic, several_publishers=topic == topics.DIAGNOSTICS)
        subscription = self.listen(
            message_type, topic, partial(self._on_message, channel), qos, raw=True
        )
        channel.name = str(subscription.topic_name)

        def announce(bag: Bag) -> None:
            channel.connection = bag.add_topic(channel.name, _type_name(message_type))

        self._with_bag(announce)
        self._channels.append(channel)
        return lambda: subscription.get_publisher_count() > 0

    def _start(self) -> None:
        qos = output_qos(self.settings, RECORDER_DEPTH)
        self._record(self._driver.output, self._driver.output_type, qos)
        emit('ready')

    def _on_message(self, channel: Channel, message: bytes, info: dict[str, Any]) -> None:
        channel.count(info['publication_sequence_number'])
        connection = channel.connection
        if self._bag is not None and connection is not None:
            stamp_ns = self._now_ns if self._lockstep else info['source_timestamp']
            if self._with_bag(lambda bag: bag.write(connection, stamp_ns, message)):
                channel.recorded += 1
        self._progress.take(channel.topic, message)

    def _on_clock(self, message: Clock) -> None:
        self._now_ns = stamp_ns_of(message)

    def _tell(self) -> None:
        content = self._progress.report()
        if content:
            received = {channel.topic: channel.received for channel in self._channels}
            emit('progress', **content, received=received)

    def _diagnose(self) -> None:
        if self._diagnostics is None:
            return
        if self._bag is None:
            text = 'recording stopped, all else goes on: see reason'
            self._diagnostics.publish(
                Finding(Level.ERROR, 'stopped', text), {'reason': self.failure}
            )
            return
        folder = self._bag.path
        self._diagnostics.publish(Finding(Level.OK, 'recording', f'recording to {folder}'), {
            'saved messages': self._bag.saved, 'free on the disk [MB]': _free_megabytes(folder),
        })


def _free_megabytes(folder: Path) -> float:
    try:
        return shutil.disk_usage(folder).free * 1e-6
    except OSError:  # somebody has removed the folder
        return nan


def _type_name(message_type: type[Any]) -> str:
    """The name that bags know a type by, like std_msgs/msg/Float64."""
    return f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 1 if the recording stopped before its time."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument('--repair', type=Path, metavar='BAG')
    try:
        options, others = parser.parse_known_args(args)
    except argparse.ArgumentError:
        print(f'{RECORDER}: --repair needs the folder of a bag', file=sys.stderr)
        return BAD_INPUT
    if options.repair is not None and not others:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        return repair_command(options.repair)
    if {'-h', '--help'} & set(others):
        print(f'{RECORDER} --repair BAG: make a bag readable that was never closed, or is damaged')
    return run(RECORDER, RecorderNode, args)


if __name__ == '__main__':
    sys.exit(main())
