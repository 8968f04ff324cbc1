"""From options to a run, and to the report on it: what `bringup` does."""

from __future__ import annotations

import argparse
import os
import socket
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from math import isinf

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.parameters import NOISE, Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import BY_NAME, PLANT
from backlash_ros.middleware.installed import ROS_MISSING, ros_is_missing
from backlash_ros.options import DONE, FAILED, LARGEST_PORT
from backlash_ros.tools.bringup.domains import free_domain
from backlash_ros.tools.bringup.processes import ProcessSupervisor, RunError
from backlash_ros.tools.bringup.progress import ProgressDisplay
from backlash_ros.tools.bringup.run_plan import (
    BAG,
    DRIVER,
    AxisPlan,
    RunPlan,
    check_driver,
    check_limits,
    plan_processes,
)
from backlash_ros.tools.bringup.supervision import Run, complain
from backlash_ros.tools.cli import (
    BrokenOffError,
    InputError,
    StopRequests,
    number_of_samples,
    print_warnings,
)
from backlash_ros.tools.config.configuration import Configuration, read_configuration, write_config
from backlash_ros.tools.runs.files import CONFIG, result_directory

# Each node takes one of the places that discovery on one machine has; some stay for listeners.
MOST_AXES = 7
ESTIMATES = 'estimates.file'


def prepare(options: argparse.Namespace) -> RunPlan:
    """Check all input, then make the result folders; raises ParameterError or InputError.

    Raises BrokenOffError where there is no ROS 2 to run the nodes with.
    """
    if ros_is_missing():
        raise BrokenOffError(ROS_MISSING)
    configuration = read_configuration(options.config, options.settings, options.seed)
    names = (options.axis,) if options.axis else configuration.axes or ('',)
    if len(names) > MOST_AXES:
        raise InputError(f'{len(names)} axes are too many for one machine: at most {MOST_AXES}')
    parameters = {name: _parameters(configuration, name, options) for name in names}
    if options.unlimited and not any(values.get_str(DRIVER) for values in parameters.values()):
        raise InputError('--unlimited is about a driver: give --driver as well')
    live_port = _live_port(options)
    _check_files(parameters)
    for name, values in parameters.items():
        print_warnings(f'bringup: {name}' if name else 'bringup', values)
    _say_unused(configuration, parameters)
    if options.out is not None:
        for name in names:
            if (options.out / name / BAG).exists():
                raise InputError(
                    f'--out={options.out}: holds a bag already, choose another folder'
                )
    # The nodes need a path that holds wherever it is read.
    out = result_directory(options.out).resolve()
    plan = RunPlan(tuple(
        AxisPlan(name, values, out / name, options.record) for name, values in parameters.items()
    ), out, live_port)
    try:
        for axis in plan.axes:
            axis.logs.mkdir(parents=True, exist_ok=True)
            write_config(axis.parameters, axis.out / CONFIG)
    except OSError as error:
        raise InputError(f'{plan.out}: cannot be written: {error.strerror}') from None
    return plan


def _parameters(
    configuration: Configuration, axis: str, options: argparse.Namespace,
) -> Parameters:
    """The parameters of an axis, checked as far as that is possible without running."""
    parameters = configuration.parameters(axis)
    try:
        changes: dict[str, object] = {
            'lockstep': options.lockstep or parameters.get_bool('lockstep'),
            'samples': _samples(parameters, options.duration),
        }
        if options.driver is not None:
            changes[DRIVER] = options.driver
        parameters = check_driver(axis, parameters.replaced(changes))
        if parameters.get_str(DRIVER) and not options.unlimited:
            check_limits(parameters)
        if parameters.get_str('bag'):
            raise ParameterError(
                'bag',
                parameters.get_str('bag'),
                'is made by bringup',
                'choose its folder with --out',
            )
        build_controller(parameters)
        if not parameters.get_str(DRIVER):
            build_plant(parameters)
        build_reference(parameters)
    except (ParameterError, InputError) as error:
        error.args = (f'{axis}: {error}' if axis else str(error),)
        raise
    return parameters


def _live_port(options: argparse.Namespace) -> int | None:
    """Port of the page, None without one; raises InputError where it cannot be had."""
    if options.live_port is None:
        return 0 if options.live else None
    port: int = options.live_port
    if not 0 <= port <= LARGEST_PORT:
        raise InputError(f'--live-port={port}: must be from 0 (a free one) to {LARGEST_PORT}')
    try:
        # As the page will do it.
        socket.create_server(('127.0.0.1', port)).close()
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise InputError(
            f'--live-port={port}: {reason}: choose another one, or leave it out'
        ) from None
    return port


def _check_files(parameters: Mapping[str, Parameters]) -> None:
    """Raise ParameterError where two axes would save their estimates in one file."""
    users: dict[str, str] = {}
    for axis, values in parameters.items():
        file = values.get_str(ESTIMATES)
        if file and users.setdefault(file, axis) != axis:
            raise ParameterError(
                ESTIMATES, file, f'is the file of {users[file]} and of {axis}',
                f'give each axis one of its own, like --set {axis}/{ESTIMATES}=...',
            )


def _samples(parameters: Parameters, duration: float | None) -> int:
    """Samples of the run, 0 for a run without end."""
    if duration is not None and isinf(duration) and duration > 0.0:
        return 0
    return number_of_samples(parameters, duration)


def _say_unused(configuration: Configuration, parameters: Mapping[str, Parameters]) -> None:
    """Say which values of the simulated plant have no use, as there is a driver."""
    unused: set[str] = set()
    noisy = False
    for axis, values in parameters.items():
        if values.get_str(DRIVER):
            given = configuration.given(axis)
            follows = NOISE not in given and values.get_float(NOISE) != BY_NAME[NOISE].default
            noisy = noisy or follows
            # What stands in a section of the plant was never meant for a run without one.
            meant = given if follows else configuration.given(axis, without=PLANT)
            unused |= {name for name in meant if BY_NAME[name].used_by == (PLANT,)}
    unused.discard('samples')  # tells the length of any run
    if unused:
        groups = {f'{name.split(".")[0]}.*' if '.' in name else name for name in unused}
        noise = f'; {NOISE}, which is not given, still follows its noise' if noisy else ''
        complain('with a driver there is no use for what describes the simulated plant: '
                 f'{", ".join(sorted(groups))}{noise}')


def perform(plan: RunPlan) -> int:
    """Run and report; returns the exit code."""
    try:
        with ExitStack() as stack:
            requests = stack.enter_context(StopRequests())
            stages = plan_processes(plan, _announced_domain(plan, stack))
            managed = [axis.process_name('controller') for axis in plan.axes if axis.is_managed]
            if managed:
                print(f'waiting until somebody activates {", ".join(managed)} (autostart: false)',
                      flush=True)
            for process in (process for stage in stages for process in stage):
                process.log.parent.mkdir(exist_ok=True)
            displays = {
                axis.name: ProgressDisplay(
                    axis.samples, axis.sample_period, sys.stderr, axis.name, line
                )
                for line, axis in enumerate(plan.axes)
            }
            # The last one entered is closed first, and the bars want it from top to bottom.
            for display in reversed(displays.values()):
                stack.callback(display.close)
            supervisor = stack.enter_context(ProcessSupervisor(stages, requests.insist))
            run = Run(plan, supervisor, requests, displays)
            run.execute()
    except RunError as error:
        complain(str(error))
        return FAILED
    reported = [run.has_samples(axis) and report(axis) for axis in plan.axes]
    return DONE if all(reported) and not run.failure else FAILED


def _announced_domain(plan: RunPlan, stack: ExitStack) -> int | None:
    """ROS_DOMAIN_ID to set, None to leave it alone; says where to listen or what is awaited."""
    discovery = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if plan.awaits_driver:
        # Whoever started the driver did so in the domain that is set there, or in none.
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        names = ', '.join(axis.name for axis in plan.axes if axis.driver_is_elsewhere)
        print(
            f'waiting for the driver{f" of {names}" if names else ""} as long as it takes: start '
            f'it with ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE={discovery}', flush=True,
        )
        return None
    if os.environ.get('ROS_DOMAIN_ID'):
        return None
    free = stack.enter_context(free_domain())
    print(
        f'to listen in: export ROS_DOMAIN_ID={free} ROS_AUTOMATIC_DISCOVERY_RANGE={discovery}',
        flush=True,
    )
    return free


def report(axis: AxisPlan) -> bool:
    """Write and print what came out of an axis; returns whether that worked."""
    if not axis.record:
        print(axis.titled(f'no bag and no report (--no-record), logs in {axis.logs}'))
        return True
    # Drawing libraries take a second to load: not before bad input is refused.
    from backlash_ros.tools.report import PAGE, report_bag
    from backlash_ros.tools.runs.summary import estimate_table
    try:
        summary = report_bag(axis.bag, axis.out, axis.parameters)
    except (InputError, OSError) as error:
        complain(axis.titled(f'no report: {error}'))
        return False
    print(estimate_table(summary, axis.name))
    facts = f'{summary["samples"]} samples, {summary["lost_samples"]} lost'
    latency = summary['loop_latency_ms']
    if latency is not None:
        facts += f', y to v within {latency["p50"]:.2f} ms (p50), {latency["p99"]:.2f} ms (p99)'
    print(facts)
    print(f'report: {axis.out / PAGE}')
    return True
