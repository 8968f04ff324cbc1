"""Watch a run: take events of its processes, decide when it is over, report the results."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack

from backlash_ros import topics
from backlash_ros.tools.bringup.plan import ELSEWHERE, Axis, complain, plan_processes, stop_times
from backlash_ros.tools.bringup.supervisor import (
    ProcessSupervisor,
    child_environment,
    free_domain,
)
from backlash_ros.tools.cli import BrokenOffError, InputError, StopRequests
from backlash_ros.tools.runs.files import BAG


def execute(
    axes: Sequence[Axis], supervisor: ProcessSupervisor, requests: StopRequests,
) -> str:
    """Wait for all samples, then stop everything; returns what went wrong, '' if nothing did."""
    failure = ''
    try:
        while not (requests.count or all(axis.complete for axis in axes)):
            take_events(supervisor, 0.1)
            check_processes(supervisor)
            for axis in axes:
                axis.check_pace([child for child in supervisor.children
                                 if child.axis is axis and not (child.foreign or child.ready)])
        # A signal is the regular end of an endless run.
        endless = any(axis.parameters.samples == 0 for axis in axes)
        if requests.count and not (endless and all(axis.made for axis in axes)):
            raise BrokenOffError(f'interrupted by {requests.last}, stopping')
        if requests.count:
            complain(f'{requests.last} ends the run')
    except BrokenOffError as error:
        failure = str(error)
        complain(failure)  # before the processes are stopped, which may take a while
    supervisor.stop()
    take_events(supervisor, 0.0)
    for child in supervisor.children if not failure else ():
        code = child.process.returncode
        # The exit code of a user's program is its own affair.
        if code and (not child.foreign or code == -signal.SIGKILL):
            failure = child.describe_end('did not stop cleanly')
            complain(failure)
    return failure


def take_events(supervisor: ProcessSupervisor, timeout_s: float) -> None:
    for child, content in supervisor.events(timeout_s):
        axis, kind = child.axis, content['event']
        if kind in ('ready', 'done'):
            axis.moved = time.monotonic()
        if kind == 'ready':
            child.ready = True
            if 'address' in content:
                print(f'{child.name}: {content["address"]}', flush=True)
        elif kind == 'done':
            axis.published = content['published']
        elif kind == 'progress':
            axis.take(content)
        elif kind == 'complaint':
            # Printed, as the log may be on the very disk that is full.
            complain(axis.titled(content['text']))


def check_processes(supervisor: ProcessSupervisor) -> None:
    """Raise BrokenOffError if a process has died without which the run cannot go on."""
    gone = [child for child in supervisor.children if child.process.poll() is not None]
    if dead := [child for child in gone if not (child.spectator and child.ready)]:
        raise BrokenOffError('\n'.join(child.describe_end('died') for child in dead))
    for child in gone:
        supervisor.children.remove(child)
        complain(child.describe_end('died', ', the run goes on without it'))


def run(axes: Sequence[Axis], record: bool, live_port: int | None) -> str:
    """Run all processes to the end; returns what went wrong, '' if nothing did.

    Raises BrokenOffError if they cannot be started.
    """
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    domain: int | str = os.environ.get('ROS_DOMAIN_ID', '')
    with StopRequests() as requests, ExitStack() as stack:
        # A driver that was started elsewhere is in the domain of the environment, or in 0.
        elsewhere = any(axis.parameters.driver == ELSEWHERE for axis in axes)
        domain = domain or (0 if elsewhere else stack.enter_context(free_domain()))
        print(f'to listen in: export ROS_DOMAIN_ID={domain} '
              f'{name}={os.environ.get(name, "LOCALHOST")}')
        for axis in axes:
            p = axis.parameters
            if p.driver == ELSEWHERE:
                print('waiting for the driver, which has to be in that domain')
            if not p.autostart:
                print(f'waiting for the activation of {axis.process_name("controller")}')
            if p.joints:
                print(f'waiting for a plan of motion on {axis.process_name(topics.ROBOT_COMMAND)}')
        sys.stdout.flush()
        supervisor = stack.enter_context(ProcessSupervisor(
            plan_processes(axes, record, live_port), child_environment(axes[0].logs, domain),
            lambda: requests.count > 1, *stop_times(axes)))
        return execute(axes, supervisor, requests)


def report(axis: Axis, record: bool) -> bool:
    """Write the reports of an axis; returns whether that succeeded."""
    # Imported here, as drawing libraries take a second to load.
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
                f'y to v {each} {ms:.2f} ms' for each, ms in latency.items()), sep=', ')
            print(f'report: {out / REPORT_PAGE}')
    return good
