"""A run in progress: what its processes say, how long to wait, when it is over, what went wrong."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping

from backlash_ros import topics
from backlash_ros.tools.bringup.axis_progress import AxisProgress
from backlash_ros.tools.bringup.processes import Child, Event, ProcessSupervisor, RunError
from backlash_ros.tools.bringup.progress import ProgressDisplay, counts
from backlash_ros.tools.bringup.run_plan import AxisPlan, RunPlan
from backlash_ros.tools.cli import StopRequests

READY_DEADLINE_S = 30.0  # for the start of every process
CATCH_UP_DEADLINE_S = 10.0  # for the recorder, after the last sample
# Reports without anything that was unheard, after which nothing is to come. The middleware sends
# again what got lost on the way to a recorder that was held up, with its own settings every 3 s.
STANDS_STILL = 20

# Where y may come from, as the ends of full names.
OUTPUTS = (f'/{topics.PLANT_OUTPUT}', f'/{topics.JOINT_STATES}')

# How a driver may end that was told to by a signal; a shell adds 128 to its number.
TOLD_TO_END = {
    code for number in (signal.SIGINT, signal.SIGTERM) for code in (-number, 128 + number)
}


class Run:
    """Watches the processes of a run from start to end.

    failure: what went wrong, empty as long as nothing did.
    """

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
        displays: Mapping[str, ProgressDisplay],
    ) -> None:
        self._plan, self._supervisor, self._requests = plan, supervisor, requests
        self._axes = {axis.name: AxisProgress(axis, displays[axis.name]) for axis in plan.axes}
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
        except RunError as error:
            # Said before the processes are stopped, which may take a while.
            self._fail(str(error))
        for event in self._supervisor.stop():
            self._note(event)
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
        if message:
            self._say(message)

    def _say(self, message: str) -> None:
        for axis in self._axes.values():
            axis.display.close()
        complain(message)

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + READY_DEADLINE_S
        while self._missing():
            self._listen()
            late = [child for child in self._missing() if not self._may_wait(child)]
            if late and time.monotonic() > deadline:
                names = ', '.join(child.plan.name for child in late)
                logs = '\n'.join(f'the end of {child.end_of_log()}' for child in late)
                raise RunError(
                    f'not ready within {READY_DEADLINE_S:g} s: {names}{self._hint()}\n{logs}'
                )

    def _hint(self) -> str:
        if not any(axis.plan.has_driver for axis in self._axes.values()):
            return ''
        return ' (a controller waits until the driver subscribes to its command)'

    def _may_wait(self, child: Child) -> bool:
        """Whether it waits for somebody who may come when he wants."""
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
        for axis in self._axes.values():
            axis.repeats = 0
        deadline = time.monotonic() + CATCH_UP_DEADLINE_S
        while not self._over and any(
            axis.unheard and axis.repeats < STANDS_STILL for axis in self._axes.values()
        ):
            self._listen()
            if time.monotonic() > deadline:
                raise RunError('the recorder does not catch up')
        for axis in self._axes.values():
            if axis.unheard:
                missing = ', '.join(f'{count} {what}' for what, count in axis.unheard.items())
                self._say(axis.plan.titled(
                    f'the plant has said more than the recorder heard: {missing}'
                ))

    def _listen(self) -> None:
        for event in self._supervisor.events(0.1):
            self._note(event)
        if self._requests.count and not self._over:
            raise RunError(f'interrupted by {self._requests.last}, stopping')
        dead = [child for child in self._supervisor.ended() if not self._may_end(child)]
        if dead:
            raise RunError('\n'.join(
                f'{child.plan.name} died ({child.describe_exit()}), the end of '
                f'{child.end_of_log()}'
                for child in dead
            ))

    def _may_end(self, child: Child) -> bool:
        """Whether the run goes on without it, which is said once."""
        name = child.plan.name
        if not child.plan.spectator or name not in self._ready:
            return False
        if name not in self._gone:
            self._gone.add(name)
            self._axes[child.plan.axis].display.say(
                f'bringup: {name} died ({child.describe_exit()}), the run goes on without it; the '
                f'end of {child.end_of_log()}'
            )
        return True

    def _note(self, event: Event) -> None:
        axis = self._axes[event.plan.axis]
        if event.kind == 'ready':
            self._ready.add(event.plan.name)
            if 'address' in event.content:
                print(f'{event.plan.name}: {event.content["address"]}', flush=True)
        elif event.kind == 'done':
            axis.published = counts(event.content, 'published')
        elif event.kind == 'progress':
            axis.take(event.content)
        elif event.kind == 'recording_stopped':
            # The log may lie on the very disk that is full.
            complain(str(event.content.get('reason', '')))
        elif event.kind == 'closed' and axis.plan.record and axis.made:
            self._tell_unheard(event.content)

    def _tell_unheard(self, closed: Mapping[str, object]) -> None:
        """Say so where the bag holds what the controller made of y, but no y."""
        if closed.get('failure'):
            return
        for topic, count in counts(closed, 'messages').items():
            if topic.endswith(OUTPUTS) and count == 0:
                self._say(
                    f'the bag holds no message of {topic}, which the controller has heard: the '
                    'recorder did not discover its publisher before the end of the run; let the '
                    f'driver wait until {topic} has two subscribers, or run longer'
                )

    def _missing(self) -> list[Child]:
        return [
            child for child in self._supervisor.children
            if not child.plan.foreign and child.plan.name not in self._ready
        ]

    def _judge_exits(self) -> None:
        """Look at how the processes have ended that were told to."""
        unclean = [
            c for c in self._supervisor.children
            if c.process.returncode != 0 and c.plan.name not in self._gone
        ]
        bad, odd = [], []
        for child in unclean:
            code = child.process.returncode
            if not child.plan.foreign or code == -signal.SIGKILL:
                bad.append(child)
            elif code not in TOLD_TO_END:
                odd.append(child)
        if self.failure:
            return
        for child in odd:
            # How a program of the user says good-bye is its own affair.
            self._say(f'{child.plan.name} was stopped and ended with {child.describe_exit()}, '
                      f'the end of {child.end_of_log()}')
        self._fail('\n'.join(
            f'{child.plan.name} did not stop cleanly ({child.describe_exit()}), the end of '
            f'{child.end_of_log()}'
            for child in bad
        ))


def complain(message: str) -> None:
    """Say on stderr what went wrong."""
    print(f'bringup: {message}', file=sys.stderr, flush=True)
