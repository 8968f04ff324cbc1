"""A run in progress: what its processes say, how long to wait, when it is over, what went wrong."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping
from math import inf, isfinite, nan
from typing import TextIO

from backlash_ros import topics
from backlash_ros.tools.bringup.plan import ELSEWHERE, AxisPlan, RunPlan
from backlash_ros.tools.bringup.supervisor import Child, Event, ProcessSupervisor
from backlash_ros.tools.cli import BrokenOffError, StopRequests

READY_DEADLINE_S = 30.0  # for the start of every process
FIRST_SAMPLE_DEADLINE_S = 30.0  # of a driver that bringup has started
LATE_DEADLINE_S = 10.0  # that a run in real time may take longer than it should


def complain(message: str) -> None:
    """Say on stderr what went wrong."""
    print(f'bringup: {message}', file=sys.stderr, flush=True)


def describe(progress: Mapping[str, object]) -> str:
    """The estimates with their errors in % of the truth, where that is known."""
    words = []
    for name in topics.BACKLASH:
        estimate, truth = _number(progress, name), _number(progress, f'true_{name}')
        words.append(f'{name} {estimate:.4g}')
        if isfinite(truth) and truth != 0.0:
            words[-1] += f' ({100.0 * (estimate - truth) / abs(truth):+.1f} %)'
    words.append(f'lost {_number(progress, "lost"):.0f}')
    return '  '.join(words)


def _number(values: Mapping[str, object], name: str) -> float:
    """A number of an event, nan for null and for what is missing."""
    value = values.get(name)
    return float(value) if isinstance(value, (int, float)) else nan


def _counts(values: Mapping[str, object], name: str) -> dict[str, int]:
    """The counts in an event by what was counted, empty where they are missing."""
    value = values.get(name)
    return value if isinstance(value, dict) else {}


class AxisProgress:
    """How far an axis has come, said now and then, and how long to wait for its next sample.

    made: samples so far. first: number of the one that counts as the first. began, moved: when the
    run began, and when the newest sample was heard of, on the monotonic clock [s]. published:
    samples and messages by topic that can have been heard of a simulated plant, once it is done.
    """

    def __init__(self, plan: AxisPlan, stream: TextIO) -> None:
        self.plan, self._stream = plan, stream
        self.made = self.first = 0
        self.began = self.moved = time.monotonic()
        self.published: Mapping[str, int] | None = None
        self._heard: dict[str, int] = {}
        self._says_silence = True
        self._next_line = 0.0  # on the monotonic clock [s]

    @property
    def patience(self) -> float:
        """How long to wait for a new sample [s]: a plant of long periods may take its time."""
        return 10.0 + 2.0 * self.plan.sample_period

    @property
    def deadline(self) -> float:
        """When the last sample must have come, on the monotonic clock [s]."""
        if self.plan.samples == 0 or self.plan.parameters.lockstep:
            return inf
        return self.began + self.plan.samples * self.plan.sample_period + LATE_DEADLINE_S

    @property
    def complete(self) -> bool:
        """Whether all samples were made; a driver does not say so, the recorder hears it."""
        if self.plan.driver:
            return 0 < self.plan.samples <= self.made
        return self.published is not None

    @property
    def unheard(self) -> dict[str, int]:
        """What is missing of the published ones."""
        return {
            what: count - self._heard.get(what, 0)
            for what, count in (self.published or {}).items() if count > self._heard.get(what, 0)
        }

    def begin(self) -> None:
        """The time starts to run."""
        self.began = self.moved = time.monotonic()

    def take(self, progress: Mapping[str, object]) -> None:
        """Take in what the recorder says."""
        sample = _number(progress, 'sample')
        if not isfinite(sample):
            return
        if self.made == 0:
            self.begin()
            # A driver may have been running before; a simulated plant begins with sample 0.
            self.first = int(sample) if self.plan.driver else 0
        made = int(sample) + 1 - self.first
        self._heard = {'samples': made, **_counts(progress, 'received')}
        if made > self.made:
            self.made, self.moved, self._says_silence = made, time.monotonic(), True
            if self.moved >= self._next_line:
                # Every 2 s, and ever more seldom, so that a run of days does not fill the disk.
                self._next_line = self.moved + max(2.0, 0.05 * (self.moved - self.began))
                of_all = f'/{self.plan.samples}' if self.plan.samples else ''
                t = made * self.plan.sample_period
                self._say(self.plan.titled(f'{t:7.2f} s  {made}{of_all}  {describe(progress)}'))

    def check_pace(self) -> None:
        """Raise BrokenOffError for samples that do not come."""
        now, plan = time.monotonic(), self.plan
        if plan.driver and self.made == 0:
            if plan.driver != ELSEWHERE and now > self.began + FIRST_SAMPLE_DEADLINE_S:
                raise BrokenOffError(plan.titled(
                    f'no sample within {FIRST_SAMPLE_DEADLINE_S:g} s: does the driver publish its '
                    f'output? See {plan.logs}; where it needs longer, start it yourself '
                    '(--driver none)'
                ))
        elif self.complete:
            return
        elif now > self.deadline:
            raise BrokenOffError(plan.titled(
                f'only {self.made} of {plan.samples} samples, {LATE_DEADLINE_S:g} s after the end '
                f'was due, see {plan.logs}'
            ))
        elif now > self.moved + self.patience:
            at = f' after sample {self.first + self.made - 1}' if self.made else ''
            silence = f'no new sample for {self.patience:g} s{at}'
            if not plan.driver:
                raise BrokenOffError(plan.titled(f'{silence}, see {plan.logs}'))
            # The controller knows what to do when a real plant falls silent.
            if self._says_silence:
                self._says_silence = False
                self._say(f'bringup: {plan.titled(silence)}, waiting for the driver')

    def _say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)


class RunWatch:
    """Watches the processes of a run from start to end.

    failure: what went wrong, empty as long as nothing did.
    """

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
        stream: TextIO = sys.stderr,
    ) -> None:
        self._plan, self._supervisor, self._requests = plan, supervisor, requests
        self._axes = {axis.name: AxisProgress(axis, stream) for axis in plan.axes}
        self._ready: set[str] = set()
        self._gone: set[str] = set()  # spectators that have died
        self.failure = ''

    def has_samples(self, axis: AxisPlan) -> bool:
        """Whether at least one sample of the axis went round the loop."""
        return self._axes[axis.name].made > 0

    def execute(self) -> None:
        """Wait until all samples are made, then stop everything; sets failure."""
        try:
            self._wait_until_ready()
            for axis in self._axes.values():
                if axis.made == 0:
                    axis.begin()
            while not (self._over or all(axis.complete for axis in self._axes.values())):
                self._listen()
                for axis in self._axes.values():
                    axis.check_pace()
            self._catch_up()
            if self._over:
                complain(f'{self._requests.last} ends the run')
        except BrokenOffError as error:
            # Said before the processes are stopped, which may take a while.
            self._fail(str(error))
        for event in self._supervisor.stop():
            self._note(event)
        if not self.failure:
            self._judge_exits()

    @property
    def _over(self) -> bool:
        """Whether the user ends a run that has no other end."""
        return (
            self._requests.count > 0 and self._plan.endless
            and all(axis.made > 0 for axis in self._axes.values())
        )

    def _fail(self, message: str) -> None:
        self.failure = message
        complain(message)

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + READY_DEADLINE_S
        while missing := [
            child for child in self._supervisor.children
            if not child.plan.foreign and child.plan.name not in self._ready
        ]:
            self._listen()
            late = [
                child for child in missing if child.plan.name not in self._ready
                and not self._axes[child.plan.axis].plan.waits(child.plan.name)
            ]
            if late and time.monotonic() > deadline:
                names = ', '.join(child.plan.name for child in late)
                hint = ' (a controller waits until the driver subscribes to its command)' \
                    if any(axis.driver for axis in self._plan.axes) else ''
                logs = '\n'.join(f'the end of {child.end_of_log()}' for child in late)
                raise BrokenOffError(
                    f'not ready within {READY_DEADLINE_S:g} s: {names}{hint}\n{logs}'
                )

    def _catch_up(self) -> None:
        """Wait until the recorder has heard all that was published, and say what is missing."""
        # The middleware sends again what got lost on the way to a recorder that was held up, with
        # its own settings every 3 s.
        deadline = time.monotonic() + 10.0
        while not self._over and time.monotonic() < deadline and any(
            axis.unheard for axis in self._axes.values()
        ):
            self._listen()
        for axis in self._axes.values():
            if axis.unheard:
                missing = ', '.join(f'{count} {what}' for what, count in axis.unheard.items())
                complain(axis.plan.titled(
                    f'the plant has published more than the recorder heard: {missing}'
                ))

    def _listen(self) -> None:
        for event in self._supervisor.events(0.1):
            self._note(event)
        if self._requests.count and not self._over:
            raise BrokenOffError(f'interrupted by {self._requests.last}, stopping')
        dead = [child for child in self._supervisor.ended() if not self._may_end(child)]
        if dead:
            raise BrokenOffError('\n'.join(child.describe_end('died') for child in dead))

    def _may_end(self, child: Child) -> bool:
        """Whether the run goes on without it, which is said once."""
        name = child.plan.name
        if not child.plan.spectator or name not in self._ready:
            return False
        if name not in self._gone:
            self._gone.add(name)
            complain(child.describe_end('died', ', the run goes on without it'))
        return True

    def _note(self, event: Event) -> None:
        axis = self._axes[event.plan.axis]
        if event.kind == 'ready':
            self._ready.add(event.plan.name)
            if 'address' in event.content:
                print(f'{event.plan.name}: {event.content["address"]}', flush=True)
        elif event.kind == 'done':
            axis.published = _counts(event.content, 'published')
        elif event.kind == 'progress':
            axis.take(event.content)
        elif event.kind == 'recording_stopped':
            # The log may lie on the very disk that is full.
            complain(str(event.content.get('reason', '')))
        elif event.kind == 'closed' and axis.plan.record and axis.made:
            _complain_of_missing_output(event.content)

    def _judge_exits(self) -> None:
        """Check the exit codes of the processes that were asked to end."""
        bad = []
        for child in self._supervisor.children:
            code = child.process.returncode
            if code == 0 or child.plan.name in self._gone:
                continue
            if not child.plan.foreign or code == -signal.SIGKILL:
                bad.append(child.describe_end('did not stop cleanly'))
            # A driver may end so of the signal that stops it; a shell adds 128 to its number.
            elif code not in (-signal.SIGINT, -signal.SIGTERM,
                              128 + signal.SIGINT, 128 + signal.SIGTERM):
                # How a program of the user says good-bye is its own affair.
                complain(child.describe_end('was stopped'))
        if bad:
            self._fail('\n'.join(bad))


def _complain_of_missing_output(closed: Mapping[str, object]) -> None:
    """Say so where a bag that was closed holds what the controller made of y, but no y."""
    outputs = topics.PLANT_OUTPUT, topics.JOINT_STATES, topics.ROBOT_STATES
    for topic, count in _counts(closed, 'messages').items():
        if not closed.get('failure') and topic.rpartition('/')[2] in outputs and count == 0:
            complain(
                f'the bag holds no message of {topic}, which the controller has heard: the '
                'recorder did not discover its publisher before the end of the run; let the '
                f'driver wait until {topic} has two subscribers, or run longer'
            )
