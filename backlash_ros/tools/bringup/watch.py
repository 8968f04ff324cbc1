"""A run in progress: what its processes say, how long to wait, when it is over, what went wrong."""

import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from backlash_ros import topics
from backlash_ros.tools.bringup.plan import ELSEWHERE, AxisPlan, RunPlan, plan_processes
from backlash_ros.tools.bringup.supervisor import Events, ProcessSupervisor, free_domain
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests, number
from backlash_ros.tools.runs.files import BAG

START_DEADLINE_S = 30.0  # for the start of every process, and the first sample of a driver


def complain(message: str, name: str = 'bringup: ') -> None:
    print(f'{name}{message}', file=sys.stderr, flush=True)


@dataclass
class AxisProgress:
    """How far an axis has come. first: number of the sample that counts as the first.

    began, moved, next_line: on the monotonic clock [s]. published: samples and messages by topic of
    a simulated plant that is done; heard: those of them that the recorder has.
    """

    plan: AxisPlan
    made: int = 0
    first: int = 0
    began: float = field(default_factory=time.monotonic)
    moved: float = field(default_factory=time.monotonic)
    next_line: float = 0.0
    published: Mapping[str, int] | None = None
    heard: Mapping[str, int] = field(default_factory=dict)
    silent: bool = False

    @property
    def patience(self) -> float:
        """How long to wait for a new sample [s]: a plant of long periods may take its time."""
        return 10.0 + 2.0 * self.plan.parameters.sample_period

    @property
    def complete(self) -> bool:
        """Whether all samples were made; a driver does not say so, the recorder hears it."""
        p = self.plan.parameters
        return 0 < p.samples <= self.made if p.driver else self.published is not None

    @property
    def unheard(self) -> dict[str, int]:
        return Counter(self.published or {}) - Counter(self.heard)

    def take(self, progress: Mapping[str, Any]) -> None:
        sample, p = progress['sample'], self.plan.parameters
        if self.made == 0:
            self.began = time.monotonic()
            # A driver may have been running before; a simulated plant begins with sample 0.
            self.first = sample if p.driver else 0
        made = sample + 1 - self.first
        self.heard = {'samples': made, **progress.get('received', {})}
        if made <= self.made:
            return
        self.made, self.moved, self.silent = made, time.monotonic(), False
        if self.moved >= self.next_line:
            # Every 2 s, and ever more seldom, so that a run of days does not fill the disk.
            self.next_line = self.moved + max(2.0, 0.05 * (self.moved - self.began))
            words = [f'{made * p.sample_period:7.2f} s', f'{made}/{p.samples or "∞"}', *(
                f'{name} {number(progress.get(name))}' for name in topics.BACKLASH
            ), f'lost {progress.get("lost", 0)}']
            complain(self.plan.titled('  '.join(words)), '')

    def check_pace(self) -> None:
        p = self.plan.parameters
        awaited = bool(p.driver) and self.made == 0
        patience = START_DEADLINE_S if awaited else self.patience
        if self.complete or self.silent or time.monotonic() < self.moved + patience \
                or (awaited and p.driver == ELSEWHERE):
            return
        at = f' after sample {self.first + self.made - 1}' if self.made else ''
        silence = f'no new sample for {patience:g} s{at}'
        if p.driver and self.made:
            # The controller knows what to do when a real plant falls silent.
            self.silent = True
            complain(self.plan.titled(f'{silence}, waiting for the driver'))
            return
        cure = ': does the driver publish its output? Where it needs longer, start it yourself ' \
               '(--driver none)' if p.driver else ''
        raise BrokenOffError(self.plan.titled(f'{silence}{cure}, see {self.plan.logs}'))


class RunWatch:
    """Watches the processes of a run. failure: what went wrong, empty as long as nothing did."""

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
    ) -> None:
        self._supervisor, self._requests = supervisor, requests
        self.axes = {axis.name: AxisProgress(axis) for axis in plan.axes}
        self.failure = ''

    def execute(self) -> None:
        """Wait until all samples are made, then stop everything; sets failure."""
        axes = self.axes.values()
        try:
            self._wait_until_ready()
            for axis in axes:
                if axis.made == 0:
                    axis.began = axis.moved = time.monotonic()
            while not (self._over or all(axis.complete for axis in axes)):
                self._listen()
                for axis in axes:
                    axis.check_pace()
            # The middleware sends again what got lost on the way to a recorder that was held up,
            # with its own settings every 3 s.
            deadline = time.monotonic() + 10.0
            while not self._over and time.monotonic() < deadline and any(a.unheard for a in axes):
                self._listen()
            if self._over:
                complain(f'{self._requests.last} ends the run')
        except BrokenOffError as error:
            # Said before the processes are stopped, which may take a while.
            self._fail(str(error))
        self._note(self._supervisor.stop())
        for child in self._supervisor.children if not self.failure else ():
            code = child.process.returncode
            # How a program of the user says good-bye is its own affair.
            if code and not child.gone and (not child.foreign or code == -signal.SIGKILL):
                self._fail(child.describe_end('did not stop cleanly'))

    def _fail(self, failure: str) -> None:
        self.failure = failure
        complain(failure)

    @property
    def _over(self) -> bool:
        """Whether the user ends a run that has no other end."""
        axes = self.axes.values()
        return self._requests.count > 0 and all(axis.made > 0 for axis in axes) \
            and any(axis.plan.parameters.samples == 0 for axis in axes)

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + START_DEADLINE_S
        while missing := [child for child in self._supervisor.children
                          if not (child.foreign or child.ready)]:
            late = [child for child in missing if not self.axes[child.axis].plan.waits]
            if late and time.monotonic() > deadline:
                hint = ' (a controller waits until the driver subscribes to its command)' \
                    if any(axis.plan.parameters.driver for axis in self.axes.values()) else ''
                raise BrokenOffError('\n'.join([
                    f'not ready within {START_DEADLINE_S:g} s: '
                    f'{", ".join(child.name for child in late)}{hint}',
                    *(f'the end of {child.end_of_log()}' for child in late)]))
            self._listen()

    def _listen(self) -> None:
        self._note(self._supervisor.events(0.1))
        if self._requests.count and not self._over:
            raise BrokenOffError(f'interrupted by {self._requests.last}, stopping')
        dead = []
        for child in self._supervisor.children:
            if child.process.poll() is None or child.gone:
                continue
            if child.spectator and child.ready:
                child.gone = True
                complain(child.describe_end('died', ', the run goes on without it'))
            else:
                dead.append(child.describe_end('died'))
        if dead:
            raise BrokenOffError('\n'.join(dead))

    def _note(self, events: Events) -> None:
        for child, content in events:
            axis, kind = self.axes[child.axis], content['event']
            if kind == 'ready':
                child.ready = True
                if 'address' in content:
                    print(f'{child.name}: {content["address"]}', flush=True)
            elif kind == 'done':
                axis.published = content['published']
            elif kind == 'progress':
                axis.take(content)
            elif kind == 'complaint':
                # The log may lie on the very disk that is full.
                complain(axis.plan.titled(content['text']))


def run(plan: RunPlan, requests: StopRequests) -> RunWatch:
    """Run all processes to the end; raises BrokenOffError where nothing can start."""
    if requests.count:
        raise BrokenOffError(f'interrupted by {requests.last}')
    discovery = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    domain = None
    with ExitStack() as stack:
        if any(axis.parameters.driver == ELSEWHERE for axis in plan.axes):
            # Whoever started the driver did so in the domain that is set there, or in none.
            print('waiting for the driver as long as it takes: start it with ROS_DOMAIN_ID='
                  f'{os.environ.get("ROS_DOMAIN_ID") or 0} '
                  f'ROS_AUTOMATIC_DISCOVERY_RANGE={discovery}')
        elif not os.environ.get('ROS_DOMAIN_ID'):
            domain = stack.enter_context(free_domain())
            print(f'to listen in: export ROS_DOMAIN_ID={domain} '
                  f'ROS_AUTOMATIC_DISCOVERY_RANGE={discovery}')
        for axis in plan.axes:
            if not axis.parameters.autostart:
                print(f'waiting until somebody activates {axis.process_name("controller")} '
                      '(autostart: false)')
            if axis.parameters.joints:
                print('waiting for whoever plans the motion, on '
                      f'{axis.process_name(topics.ROBOT_COMMAND)}')
        sys.stdout.flush()
        stages = plan_processes(plan, domain)
        supervisor = stack.enter_context(ProcessSupervisor(stages, lambda: requests.count > 1))
        watch = RunWatch(plan, supervisor, requests)
        watch.execute()
    return watch


def report(axis: AxisPlan) -> bool:
    # Drawing libraries take a second to load: not before bad input is refused.
    from backlash_ros.tools.report import REPORT_PAGE, write_report
    from backlash_ros.tools.runs.read_run import read_run
    from backlash_ros.tools.runs.summary import estimate_table
    if not axis.record:
        print(axis.titled(f'no bag and no report (--no-record), logs in {axis.logs}'))
        return True
    good = True
    for joint in axis.parameters.joint_names:
        out = axis.out / joint
        try:
            out.mkdir(exist_ok=True)
            summary = write_report(read_run(axis.out / BAG, axis=joint), out)
        except (InputError, OSError) as error:
            complain(axis.titled(f'no report: {error}'))
            good = False
            continue
        print(estimate_table(summary, joint or axis.name))
        latency = summary['loop_latency_ms']
        print(f'{summary["samples"]} samples, {summary["lost_samples"]} lost', *(
            f'y to v within {latency[each]:.2f} ms ({each})' for each in latency or ()), sep=', ')
        print(f'report: {out / REPORT_PAGE}')
    return good
