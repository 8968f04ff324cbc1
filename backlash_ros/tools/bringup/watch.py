"""A run in progress: what its processes say, when it is over, what went wrong, its reports."""

import os
import signal
import sys
import time
from contextlib import ExitStack

from backlash_ros import topics
from backlash_ros.tools.bringup.plan import ELSEWHERE, Axis, RunPlan, complain, plan_processes
from backlash_ros.tools.bringup.supervisor import (
    ProcessSupervisor,
    child_environment,
    free_domain,
)
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests
from backlash_ros.tools.runs.files import BAG


class RunWatch:
    """Watches the processes of a run. failure: what went wrong, empty as long as nothing did."""

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
    ) -> None:
        self._supervisor, self._requests = supervisor, requests
        self._axes = {axis.name: axis for axis in plan.axes}
        self._unready = {child for child in supervisor.children if not child.foreign}
        self.failure = ''

    def execute(self) -> None:
        """Wait until all samples are made, then stop everything; sets failure."""
        axes = self._axes.values()
        try:
            while not (self._over or all(axis.complete for axis in axes)):
                self._listen()
                for axis in axes:
                    axis.check_pace([child for child in self._unready if child.axis == axis.name])
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
        self._supervisor.stop()
        self._take_events(0.0)
        for child in self._supervisor.children if not self.failure else ():
            code = child.process.returncode
            # How a program of the user says good-bye is its own affair.
            if code and (not child.foreign or code == -signal.SIGKILL):
                self._fail(child.describe_end('did not stop cleanly'))

    def _fail(self, failure: str) -> None:
        self.failure = failure
        complain(failure)

    @property
    def _over(self) -> bool:
        """Whether the user ends a run that has no other end."""
        axes = self._axes.values()
        return self._requests.count > 0 and all(axis.made > 0 for axis in axes) \
            and any(axis.parameters.samples == 0 for axis in axes)

    def _listen(self) -> None:
        self._take_events(0.1)
        if self._requests.count and not self._over:
            raise BrokenOffError(f'interrupted by {self._requests.last}, stopping')
        dead = []
        for child in [*self._supervisor.children]:
            if child.process.poll() is not None:
                if child.spectator and child not in self._unready:
                    self._supervisor.children.remove(child)
                    complain(child.describe_end('died', ', the run goes on without it'))
                else:
                    dead.append(child.describe_end('died'))
        if dead:
            raise BrokenOffError('\n'.join(dead))

    def _take_events(self, timeout_s: float) -> None:
        for child, content in self._supervisor.events(timeout_s):
            axis, kind = self._axes[child.axis], content['event']
            if kind == 'ready':
                self._unready.discard(child)
                axis.moved = time.monotonic()
                if 'address' in content:
                    print(f'{child.name}: {content["address"]}', flush=True)
            elif kind == 'done':
                axis.published = content['published']
            elif kind == 'progress':
                axis.take(content)
            elif kind == 'complaint':
                # The log may lie on the very disk that is full.
                complain(axis.titled(content['text']))


def run(plan: RunPlan) -> str:
    """Run all processes to the end; what went wrong, '' where nothing did.

    Raises BrokenOffError where nothing can start.
    """
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    discovery = f'{name}={os.environ.get(name, "LOCALHOST")}'
    domain = None
    with StopRequests() as requests, ExitStack() as stack:
        if any(axis.parameters.driver == ELSEWHERE for axis in plan.axes):
            # Whoever started the driver did so in the domain that is set there, or in none.
            print('waiting for the driver as long as it takes: start it with ROS_DOMAIN_ID='
                  f'{os.environ.get("ROS_DOMAIN_ID") or 0} {discovery}')
        elif not os.environ.get('ROS_DOMAIN_ID'):
            domain = stack.enter_context(free_domain())
            print(f'to listen in: export ROS_DOMAIN_ID={domain} {discovery}')
        for axis in plan.axes:
            if not axis.parameters.autostart:
                print(f'waiting until somebody activates {axis.process_name("controller")} '
                      '(autostart: false)')
            if axis.parameters.joints:
                print('waiting for whoever plans the motion, on '
                      f'{axis.process_name(topics.ROBOT_COMMAND)}')
        sys.stdout.flush()
        supervisor = stack.enter_context(ProcessSupervisor(
            plan_processes(plan), child_environment(plan.axes[0].logs, domain),
            lambda: requests.count > 1, *plan.stop_times))
        watch = RunWatch(plan, supervisor, requests)
        watch.execute()
    return watch.failure


def report(axis: Axis, record: bool) -> bool:
    """Report what was recorded of an axis; whether it could be."""
    # Drawing libraries take a second to load: not before bad input is refused.
    from backlash_ros.tools.report import REPORT_PAGE, write_report
    from backlash_ros.tools.runs.read_run import read_run
    from backlash_ros.tools.runs.summary import estimate_table
    if not record:
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
        else:
            latency = summary['loop_latency_ms'] or {}
            print(estimate_table(summary, joint or axis.name))
            print(f'{summary["samples"]} samples, {summary["lost_samples"]} lost', *(
                f'y to v within {ms:.2f} ms ({each})' for each, ms in latency.items()), sep=', ')
            print(f'report: {out / REPORT_PAGE}')
    return good
