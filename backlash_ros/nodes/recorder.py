"""Node that records all topics of the loop to a bag and tells how the run is going."""

import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import isfinite, nan
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.time import Time
from rosbags.interfaces import Connection
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.bags import REPAIR_COMMAND, Bag, RecordingError, repair_command
from backlash_ros.core.loop.diagnosis import Finding, Level
from backlash_ros.core.loop.sample_counter import UNNUMBERED
from backlash_ros.core.parameters import RECORDER
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.driver_io import driver_topics, output_qos
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ENABLED, ProcessNode, emit, run
from backlash_ros.options import BAD_INPUT, FAILED

RECORDER_DEPTH = 10_000  # messages that may wait while the disk is slow


@dataclass
class RecordedTopic:
    subscription: Subscription
    connection: Connection | None = None
    newest: bytes = b''  # serialised
    received: int = 0
    recorded: int = 0
    missed: int = 0
    sequence: int = UNNUMBERED  # of the newest message

    @property
    def name(self) -> str:
        return str(self.subscription.topic_name)


def _row(topic: str, message: bytes) -> dict[str, float]:
    data = deserialize_message(message, Float64MultiArray).data if message else ()
    return dict(zip(topics.LABELS_OF[topic], data, strict=False))


class RecorderNode(ProcessNode):
    """Writes messages as they came, stamped with the time (in lockstep simulated) of departure.

    Without a bag it tells the progress alone, as where the disk takes no more: failure says why.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        p, self.failure = self.settings, ''
        self._now_ns: int | None = 0 if p.lockstep else None  # simulated time
        self._channels: dict[str, RecordedTopic] = {}
        self._first_signals = b''
        self._bag = self._open_bag(p.bag, p.storage) if p.bag else None
        self.log.info(f'started: records to {p.bag} ({p.storage})' if p.bag else
                      'started: nothing is recorded, as the parameter bag names no folder')
        to = driver_topics(p)
        # y comes last of all: it starts the loop.
        for topic, kind in {
            **dict.fromkeys(topics.LABELS_OF, Float64MultiArray),
            topics.DIAGNOSTICS: DiagnosticArray,
            **{topic: to.types[topic] for topic in (to.reference, to.applied, to.control)},
        }.items():
            # A G that was learned before this recorder came belongs into the bag as well.
            kept = topic == topics.MODEL
            self._record(topic, kind, messages.KEPT_QOS if kept else RECORDER_DEPTH)
        if p.lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, RECORDER_DEPTH)
        if ENABLED:
            self.every(0.2, self._tell)
        # Lockstep promises every row: that of the first truth leaves as soon as y is subscribed to.
        truth = (topics.TRUTH,) if p.lockstep else ()
        wanted = (topics.ESTIMATES, topics.SIGNALS, *truth, to.reference, to.control)
        self.start_when(
            lambda: not p.wait_for_publishers or all(
                self._channels[topic].subscription.get_publisher_count() for topic in wanted
            ),
            lambda: self._record(to.output, to.types[to.output], output_qos(p, RECORDER_DEPTH)),
            ', '.join(wanted),
        )

    def work(self, executor: PromptExecutor) -> None:
        super().work(executor)
        # What has arrived belongs into the bag. Five times, as timers are served in between; a
        # signal has to end it within a second.
        deadline, idle = time.monotonic() + 0.3, 0
        while idle < 5 and time.monotonic() < deadline:
            received = self._received
            executor.spin_once(timeout_sec=0.0)
            idle = idle + 1 if received == self._received else 0

    def finish(self) -> None:
        bag, channels = self._bag, self._channels.values()
        if self._with_bag(Bag.close) and bag:
            self.log.info(
                f'recorded {bag.saved} messages of {bag.saved_ns * 1e-9:.1f} s to {bag.path}'
            )
            output = self._channels.get(driver_topics(self.settings).output)
            if self._first_signals and not (output and output.recorded):
                self._complain(
                    'the bag holds no output of the driver, which the controller has heard: the '
                    'recorder did not discover its publisher before the end; let the driver wait '
                    'until its output has two subscribers, or run longer'
                )
        for channel in channels:
            if channel.missed:
                self.log.warning(f'{channel.missed} messages of {channel.name} were missed')
        if self.failure:
            unrecorded = self._received - sum(channel.recorded for channel in channels)
            self.log.warning(f'{unrecorded} messages came after the recording had stopped')
        emit('closed', messages={channel.name: channel.recorded for channel in channels})

    @property
    def _received(self) -> int:
        return sum(channel.received for channel in self._channels.values())

    def _open_bag(self, path: str, storage: str) -> Bag:
        bag = Bag(path, storage)
        if not bag.survives_a_crash:
            self.log.warning(
                'the installed version of rosbags cannot be flushed: a crash of the recorder or a '
                'power cut loses everything. Install the version that requirements/run.txt names'
            )
        diagnostics = messages.DiagnosticsPublisher(self, path)

        def diagnose() -> None:
            finding = Finding(Level.OK, 'recording', f'recording to {path}')
            if self.failure:
                finding = Finding(Level.ERROR, 'stopped', 'recording stopped, all else goes on')
            # The log has it already.
            diagnostics.publish(finding, {'reason': self.failure}, logs=False)

        self.every(messages.DIAGNOSTICS_PERIOD_S, diagnose)
        # A crash or a power cut costs half a second, with the time that a flush takes.
        self.every(0.4, lambda: self._with_bag(Bag.flush))
        return bag

    def _with_bag(self, action: Callable[[Bag], None]) -> bool:
        """Do something with the bag; returns whether there is one and it went well."""
        if (bag := self._bag) is None:
            return False
        try:
            action(bag)
            return True
        except RecordingError as error:
            self._bag, self.exit_code = None, FAILED
            self.failure = (
                f'recording to {bag.path} stopped: {error}; saved are {bag.saved} messages of '
                f'{bag.saved_ns * 1e-9:.1f} s; all else goes on. Make room, then: '
                f'{REPAIR_COMMAND} {bag.path}'
            )
            self._complain(self.failure)
            return False

    def _complain(self, text: str) -> None:
        self.log.error(text)
        emit('complaint', text=text)

    def _record(self, topic: str, message_type: type[Any], qos: QoSProfile | int) -> None:
        channel = self._channels[topic] = RecordedTopic(
            self.listen(message_type, topic, partial(self._on_message, topic), qos, raw=True)
        )

        def announce(bag: Bag) -> None:
            channel.connection = bag.add_topic(channel.name, messages.name_of_type(message_type))

        self._with_bag(announce)

    def _on_message(self, topic: str, message: bytes, info: dict[str, Any]) -> None:
        channel, sequence = self._channels[topic], info['publication_sequence_number']
        channel.received += 1
        channel.newest = message
        # Each of several publishers has numbers of its own.
        if UNNUMBERED not in (sequence, channel.sequence) and topic != topics.DIAGNOSTICS:
            channel.missed += max(sequence - channel.sequence - 1, 0)
        channel.sequence = sequence
        if (connection := channel.connection) is not None:
            stamp_ns = info['source_timestamp'] if self._now_ns is None else self._now_ns
            channel.recorded += self._with_bag(lambda bag: bag.write(connection, stamp_ns, message))
        if topic == topics.SIGNALS:
            self._first_signals = self._first_signals or message

    def _on_clock(self, message: Clock) -> None:
        self._now_ns = Time.from_msg(message.clock).nanoseconds

    def _tell(self) -> None:
        """Say how the run is going, of its first joint if it has several."""
        signals, estimates = (
            _row(topic, self._channels[topic].newest)
            for topic in (topics.SIGNALS, topics.ESTIMATES)
        )
        received = {topic: channel.received for topic, channel in self._channels.items()}
        first = _row(topics.SIGNALS, self._first_signals).get('sample', nan)
        # A joint that was not answered has nan for everything.
        samples = [row.get('sample', nan) for row in (signals, estimates)]
        if all(map(isfinite, (*samples, first))):
            emit(
                'progress', sample=int(min(samples)), received=received,
                lost=int(signals['sample'] - first) + 1 - received[topics.SIGNALS],
                **{name: estimates[name] for name in topics.BACKLASH},
            )


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 1 if the recording stopped before its time."""
    arguments = sys.argv[1:] if args is None else args
    if arguments[:1] == ['--repair']:
        if len(arguments) != 2:
            print(f'{RECORDER}: --repair needs the folder of a bag, and nothing else',
                  file=sys.stderr)
            return BAD_INPUT
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        return repair_command(Path(arguments[1]))
    if {'-h', '--help'} & set(arguments):
        print(f'{RECORDER} --repair BAG: make a bag readable that was never closed, or is damaged')
    return run(RECORDER, RecorderNode, args)


if __name__ == '__main__':
    sys.exit(main())
