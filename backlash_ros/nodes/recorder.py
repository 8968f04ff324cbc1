"""Node that records all topics of the loop to a bag and reports the progress of the run."""

import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.bags import REPAIR_COMMAND, Bag, RecordingError, repair_command
from backlash_ros.core.loop.diagnosis import Finding, Level
from backlash_ros.core.loop.sample_counter import UNNUMBERED
from backlash_ros.core.parameters import RECORDER
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.driver_io import driver_topics, output_qos
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ProcessNode, emit, run
from backlash_ros.options import BAD_INPUT, FAILED

RECORDER_DEPTH = 10_000  # messages that may wait while the disk is slow


@dataclass
class RecordedTopic:
    subscription: Subscription
    connection: Any = None  # in the bag, if there is one
    newest: bytes = b''  # serialised
    received: int = 0
    missed: int = 0
    sequence: int = UNNUMBERED  # number of the newest message

    def row(self, labels: Sequence[str]) -> dict[str, float]:
        """The newest message of an array topic by label, of the first joint only."""
        data = deserialize_message(self.newest, Float64MultiArray).data if self.newest else ()
        return dict(zip(labels, data, strict=False))


class RecorderNode(ProcessNode):
    """Writes messages as they came, stamped with the time of sending (simulated in lockstep).

    Without a bag, or after writing has failed, it only reports progress. failure: why it failed.
    """

    def __init__(self) -> None:
        super().__init__(RECORDER)
        p, self.failure = self.settings, ''
        self._now_ns: int | None = 0 if p.lockstep else None  # simulated time
        self._channels: dict[str, RecordedTopic] = {}
        self._before = inf  # samples before the first one that was heard
        self._unrecorded = 0  # messages that came without a bag
        self._bag = self._open_bag(p.bag, p.storage) if p.bag else None
        self.log.info(f'started: records to {p.bag} ({p.storage})' if p.bag else
                      'started: nothing is recorded, as the parameter bag names no folder')
        to = driver_topics(p)
        # plant_output is subscribed last, in work(): that starts the loop.
        for topic, kind in {
            **dict.fromkeys(topics.LABELS_OF, Float64MultiArray),
            topics.DIAGNOSTICS: DiagnosticArray,
            **{topic: to.types[topic] for topic in (to.reference, to.applied, to.control)},
        }.items():
            # A G that was learned before this recorder started belongs in the bag as well.
            kept = topic == topics.MODEL
            self._record(topic, kind, messages.KEPT_QOS if kept else RECORDER_DEPTH)
        if p.lockstep:
            self.listen_to_clock(self._on_tick, RECORDER_DEPTH)
        self.every(0.2, self._tell)

    def work(self, executor: PromptExecutor) -> None:
        p, to = self.settings, driver_topics(self.settings)
        # Lockstep promises every row: the first truth is sent as soon as y is subscribed to.
        truth = (topics.TRUTH,) if p.lockstep else ()
        wanted = (topics.ESTIMATES, topics.SIGNALS, *truth, to.reference, to.control)
        if self.wait_until(executor, lambda: not p.wait_for_publishers or all(
            self._channels[topic].subscription.get_publisher_count() for topic in wanted
        ), ', '.join(wanted)):
            self._record(to.output, to.types[to.output], output_qos(p, RECORDER_DEPTH))
            emit('ready')
        super().work(executor)
        # What has arrived belongs in the bag, but a signal has to end the node within a second.
        deadline = time.monotonic() + 0.3
        while executor.serve_urgent(10_000_000) and time.monotonic() < deadline:
            pass

    def finish(self) -> None:
        self._with_bag(Bag.close)
        if bag := self._bag:
            self.log.info(
                f'recorded {bag.saved} messages of {bag.saved_ns * 1e-9:.1f} s to {bag.path}'
            )
            output = driver_topics(self.settings).output
            if self._channels[topics.SIGNALS].received and output not in self._heard:
                self._complain(
                    f'the controller has heard {output}, of which the bag holds nothing: its '
                    'publisher was not discovered here before the end; let the driver wait until '
                    'its output has two subscribers, or run longer'
                )
        if self.failure:
            self.log.warning(f'{self._unrecorded} messages came after the recording had stopped')
        channels = self._channels.values()
        for channel in channels:
            if channel.missed:
                name = channel.subscription.topic_name
                self.log.warning(f'{channel.missed} messages of {name} were missed')
        emit('closed', messages={each.subscription.topic_name: each.received for each in channels})

    @property
    def _heard(self) -> dict[str, int]:
        """Number of messages heard by topic, of those topics that had any."""
        return {topic: each.received for topic, each in self._channels.items() if each.received}

    def _open_bag(self, path: str, storage: str) -> Bag:
        bag = Bag(path, storage)
        if not bag.survives_a_crash:
            self.log.warning(
                'a crash of the recorder or a power cut loses everything with this version of '
                'rosbags: install the one that requirements/run.txt names'
            )
        diagnostics = messages.DiagnosticsPublisher(self, path)
        well = Finding(Level.OK, 'recording', f'recording to {path}')
        failed = Finding(Level.ERROR, 'stopped', 'recording stopped, all else goes on')
        # A failure is in the log already.
        self.every(messages.DIAGNOSTICS_PERIOD_S, lambda: diagnostics.publish(
            failed if self.failure else well, {'reason': self.failure}, logs=False
        ))
        # A crash or a power cut costs half a second, including the time of a flush.
        self.every(0.4, lambda: self._with_bag(Bag.flush))
        return bag

    def _with_bag(self, action: Callable[[Bag], Any]) -> Any:
        """Do something with the bag, if there is one. If that fails, recording stops."""
        if (bag := self._bag) is None:
            return None
        try:
            return action(bag)
        except RecordingError as error:
            self._bag, self.exit_code = None, FAILED
            self.failure = (
                f'recording to {bag.path} stopped: {error}; saved are {bag.saved} messages of '
                f'{bag.saved_ns * 1e-9:.1f} s; all else goes on. Make room, then: '
                f'{REPAIR_COMMAND} {bag.path}'
            )
            self._complain(self.failure)
            return None

    def _complain(self, text: str) -> None:
        self.log.error(text)
        emit('complaint', text=text)

    def _record(self, topic: str, message_type: type[Any], qos: QoSProfile | int) -> None:
        callback = partial(self._on_message, topic)
        subscription = self.listen(message_type, topic, callback, qos, raw=True)
        self._channels[topic] = RecordedTopic(subscription, self._with_bag(
            lambda bag: bag.add_topic(subscription.topic_name, messages.name_of_type(message_type))
        ))

    def _on_message(self, topic: str, message: bytes, info: dict[str, Any]) -> None:
        channel = self._channels[topic]
        channel.received += 1
        channel.newest, sequence = message, info['publication_sequence_number']
        # /diagnostics has several publishers, each with numbers of its own.
        if UNNUMBERED not in (sequence, channel.sequence) and topic != topics.DIAGNOSTICS:
            channel.missed += max(sequence - channel.sequence - 1, 0)
        channel.sequence = sequence
        stamp_ns = info['source_timestamp'] if self._now_ns is None else self._now_ns
        self._with_bag(lambda bag: bag.write(channel.connection, stamp_ns, message))
        self._unrecorded += self._bag is None

    def _on_tick(self, time_ns: int) -> None:
        self._now_ns = time_ns

    def _tell(self) -> None:
        """Report the progress of the run, by its first joint if there are several."""
        signals, estimates = (
            self._channels[topic].row(topics.LABELS_OF[topic])
            for topic in (topics.SIGNALS, topics.ESTIMATES)
        )
        # The row of a joint without a step is nan.
        samples = [row.get('sample', nan) for row in (signals, estimates)]
        if all(map(isfinite, samples)):
            unheard = samples[0] + 1 - self._channels[topics.SIGNALS].received
            self._before = min(self._before, unheard)
            emit(
                'progress', sample=int(min(samples)), received=self._heard,
                lost=int(unheard - self._before),
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
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)
        return repair_command(Path(arguments[1]))
    if {'-h', '--help'} & set(arguments):
        print(f'{RECORDER} --repair BAG: make a bag readable that was never closed or is damaged')
    return run(RECORDER, RecorderNode, args)


if __name__ == '__main__':
    sys.exit(main())
