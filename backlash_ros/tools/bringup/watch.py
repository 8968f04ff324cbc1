"""A run in progress: what its processes say, how long to wait, when it is over, what went wrong."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping
from math import inf, isfinite, nan
from typing import TextIO

from tqdm import tqdm

from backlash_ros import topics
from backlash_ros.tools.bringup.plan import AxisPlan, RunPlan
from backlash_ros.tools.bringup.supervisor import Child, Event, ProcessSupervisor
from backlash_ros.tools.cli import BrokenOffError, StopRequests

READY_DEADLINE_S = 30.0  # for the start of every process
FIRST_SAMPLE_DEADLINE_S = 30.0  # of a driver that bringup has started
STALL_DEADLINE_S = 10.0  # without a new sample
LATE_DEADLINE_S = 10.0  # that a run in real time may take longer than it should
# For the recorder, after the last sample: the middleware sends again what got lost on the way to a
# recorder that was held up, with its own settings every 3 s.
CATCH_UP_DEADLINE_S = 10.0
PLAIN_LINE_PERIOD_S = 2.0  # between two lines of progress where there is no terminal

# Where y may come from, as the ends of full names.
OUTPUTS = (f'/{topics.PLANT_OUTPUT}', f'/{topics.JOINT_STATES}')
# How a driver may end that was told to by a signal; a shell adds 128 to its number.
TOLD_TO_END = {
    code for number in (signal.SIGINT, signal.SIGTERM) for code in (-number, 128 + number)
}


def complain(message: str) -> None:
    """Say on stderr what went wrong."""
    print(f'bringup: {message}', file=sys.stderr, flush=True)


class ProgressDisplay:
    """Progress of an axis: a bar on a terminal, now and then a plain line anywhere else.

    line: the one of its bar among those of all axes.
    """

    def __init__(self, plan: AxisPlan, stream: TextIO, line: int = 0) -> None:
        self._plan, self._stream = plan, stream
        self._next_line = 0.0  # when a plain one is due, on the monotonic clock [s]
        self._bar: tqdm[None] | None = None
        # The terminals of containers and recorders may have no size: tqdm would show nothing.
        if stream.isatty() and all(os.get_terminal_size(stream.fileno())):
            tqdm.monitor_interval = 0  # no thread beside the loop that starts processes
            done = '{percentage:3.0f} % |{bar:16}| {n_fmt}/{total_fmt}' if plan.samples \
                else '{n_fmt}'
            self._bar = tqdm(
                total=plan.samples or None, file=stream, dynamic_ncols=True, position=line,
                bar_format=f'{plan.titled(done)}{{postfix}}',
            )

    def show(self, progress: Mapping[str, object], made: int) -> None:
        """Show one progress event; made: samples so far."""
        if self._bar is not None:
            self._bar.n = made
            self._bar.set_postfix_str(describe(progress))
        elif time.monotonic() >= self._next_line:
            self._next_line = time.monotonic() + PLAIN_LINE_PERIOD_S
            of_all = f'/{self._plan.samples}' if self._plan.samples else ''
            t = made * self._plan.sample_period
            self.say(self._plan.titled(f'{t:7.2f} s  {made}{of_all}  {describe(progress)}'))

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        if self._bar is not None:
            self._bar.write(line, file=self._stream)
        else:
            print(line, file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the bar as it is and free the line below it."""
        if self._bar is not None:
            self._bar.close()


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
    """How far an axis has come, and how long to wait for its next sample.

    made: samples so far. first: number of the one that counts as the first. began, moved: when the
    run began, and when the newest sample was heard of, on the monotonic clock [s]. published:
    samples and messages by topic that can have been heard of a simulated plant, once it is done.
    """

    def __init__(self, plan: AxisPlan, display: ProgressDisplay) -> None:
        self.plan, self.display = plan, display
        self.made = self.first = 0
        self.began = self.moved = time.monotonic()
        self.published: Mapping[str, int] | None = None
        self._heard: dict[str, int] = {}
        self._silence_told = False

    @property
    def patience(self) -> float:
        """How long to wait for a new sample [s]: a plant of long periods may take its time."""
        return STALL_DEADLINE_S + 2.0 * self.plan.sample_period

    @property
    def deadline(self) -> float:
        """When the last sample must have come, on the monotonic clock [s]."""
        if self.plan.samples == 0 or self.plan.parameters.get_bool('lockstep'):
            return inf
        return self.began + self.plan.samples * self.plan.sample_period + LATE_DEADLINE_S

    @property
    def complete(self) -> bool:
        """Whether all samples were made; a driver does not say so, the recorder hears it."""
        if self.plan.has_driver:
            return 0 < self.plan.samples <= self.made
        return self.published is not None

    @property
    def unheard(self) -> dict[str, int]:
        """What is missing of the published ones."""
        missing = {
            what: count - self._heard.get(what, 0)
            for what, count in (self.published or {}).items()
        }
        return {what: count for what, count in missing.items() if count > 0}

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
            self.first = int(sample) if self.plan.has_driver else 0
        made = int(sample) + 1 - self.first
        self._heard = {'samples': made, **_counts(progress, 'received')}
        if made > self.made:
            self.made, self.moved, self._silence_told = made, time.monotonic(), False
            self.display.show(progress, made)

    def check_pace(self) -> None:
        """Raise BrokenOffError for samples that do not come."""
        now, plan = time.monotonic(), self.plan
        if plan.has_driver and self.made == 0:
            if not plan.driver_is_elsewhere and now > self.began + FIRST_SAMPLE_DEADLINE_S:
                raise BrokenOffError(plan.titled(
                    f'no sample within {FIRST_SAMPLE_DEADLINE_S:g} s: does the driver publish its '
                    f'output? See {plan.logs}; where it needs longer, start it yourself '
                    '(--driver none)'
                ))
            return
        if self.complete:
            return
        if now > self.deadline:
            raise BrokenOffError(plan.titled(
                f'only {self.made} of {plan.samples} samples, {LATE_DEADLINE_S:g} s after the end '
                f'was due, see {plan.logs}'
            ))
        if now > self.moved + self.patience:
            at = f' after sample {self.first + self.made - 1}' if self.made else ''
            silence = plan.titled(f'no new sample for {self.patience:g} s{at}')
            if not plan.has_driver:
                raise BrokenOffError(f'{silence}, see {plan.logs}')
            # The controller knows what to do when a real plant falls silent.
            if not self._silence_told:
                self._silence_told = True
                self.display.say(f'bringup: {silence}, waiting for the driver')


class RunWatch:
    """Watches the processes of a run from start to end.

    failure: what went wrong, empty as long as nothing did.
    """

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
        stream: TextIO = sys.stderr,
    ) -> None:
        self._plan, self._supervisor, self._requests = plan, supervisor, requests
        self._axes = {
            axis.name: AxisProgress(axis, ProgressDisplay(axis, stream, line))
            for line, axis in enumerate(plan.axes)
        }
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
                self._say(f'{self._requests.last} ends the run')
        except BrokenOffError as error:
            # Said before the processes are stopped, which may take a while.
            self._fail(str(error))
        for event in self._supervisor.stop():
            self._note(event)
        if not self.failure:
            self._judge_exits()
        for axis in self._axes.values():
            axis.display.close()

    @property
    def _over(self) -> bool:
        """Whether the user ends a run that has no other end."""
        return (
            self._requests.count > 0 and self._plan.endless
            and all(axis.made > 0 for axis in self._axes.values())
        )

    def _fail(self, message: str) -> None:
        self.failure = message
        self._say(message)

    def _say(self, message: str) -> None:
        """Print a line above all bars."""
        next(iter(self._axes.values())).display.say(f'bringup: {message}')

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + READY_DEADLINE_S
        while self._missing():
            self._listen()
            late = [child for child in self._missing() if not self._may_wait(child)]
            if late and time.monotonic() > deadline:
                names = ', '.join(child.plan.name for child in late)
                hint = ' (a controller waits until the driver subscribes to its command)' \
                    if any(axis.has_driver for axis in self._plan.axes) else ''
                logs = '\n'.join(f'the end of {child.end_of_log()}' for child in late)
                raise BrokenOffError(
                    f'not ready within {READY_DEADLINE_S:g} s: {names}{hint}\n{logs}'
                )

    def _missing(self) -> list[Child]:
        return [
            child for child in self._supervisor.children
            if not child.plan.foreign and child.plan.name not in self._ready
        ]

    def _may_wait(self, child: Child) -> bool:
        """Whether it waits for somebody who may come at any time."""
        axis = self._axes[child.plan.axis].plan
        waiting = []
        if axis.driver_is_elsewhere or axis.is_managed:
            waiting.append(axis.process_name('controller'))
        if axis.is_managed:
            # The plant begins when the controller listens.
            waiting.append(axis.process_name('plant'))
        return child.plan.name in waiting

    def _catch_up(self) -> None:
        """Wait until the recorder has told of all that was published, and say what is missing."""
        deadline = time.monotonic() + CATCH_UP_DEADLINE_S
        while not self._over and time.monotonic() < deadline and any(
            axis.unheard for axis in self._axes.values()
        ):
            self._listen()
        for axis in self._axes.values():
            if axis.unheard:
                missing = ', '.join(f'{count} {what}' for what, count in axis.unheard.items())
                self._say(axis.plan.titled(
                    f'the plant has published more than the recorder heard: {missing}'
                ))

    def _listen(self) -> None:
        for event in self._supervisor.events(0.1):
            self._note(event)
        if self._requests.count and not self._over:
            raise BrokenOffError(f'interrupted by {self._requests.last}, stopping')
        dead = [child for child in self._supervisor.ended() if not self._may_end(child)]
        if dead:
            raise BrokenOffError('\n'.join(_end(child, 'died') for child in dead))

    def _may_end(self, child: Child) -> bool:
        """Whether the run goes on without it, which is said once."""
        name = child.plan.name
        if not child.plan.spectator or name not in self._ready:
            return False
        if name not in self._gone:
            self._gone.add(name)
            self._say(_end(child, 'died', ', the run goes on without it'))
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
            self._say(str(event.content.get('reason', '')))
        elif event.kind == 'closed' and axis.plan.record and axis.made:
            self._report_unheard(event.content)

    def _report_unheard(self, closed: Mapping[str, object]) -> None:
        """Say so where the bag holds what the controller made of y, but no y."""
        if closed.get('failure'):
            return
        for topic, count in _counts(closed, 'messages').items():
            if topic.endswith(OUTPUTS) and count == 0:
                self._say(
                    f'the bag holds no message of {topic}, which the controller has heard: the '
                    'recorder did not discover its publisher before the end of the run; let the '
                    f'driver wait until {topic} has two subscribers, or run longer'
                )

    def _judge_exits(self) -> None:
        """Look at how the processes have ended that were told to."""
        bad = []
        for child in self._supervisor.children:
            code = child.process.returncode
            if code == 0 or child.plan.name in self._gone:
                continue
            if not child.plan.foreign or code == -signal.SIGKILL:
                bad.append(_end(child, 'did not stop cleanly'))
            elif code not in TOLD_TO_END:
                # How a program of the user says good-bye is its own affair.
                self._say(_end(child, 'was stopped'))
        if bad:
            self._fail('\n'.join(bad))


def _end(child: Child, what: str, further: str = '') -> str:
    return (
        f'{child.plan.name} {what} ({child.describe_exit()}){further}, the end of '
        f'{child.end_of_log()}'
    )
