"""From options to a checked plan of a run: its axes, and the processes of each."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import NamedTuple

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.middleware import ROS_MISSING, ros_is_missing
from backlash_ros.tools.bringup.supervisor import Child, child_environment, foreign_environment
from backlash_ros.tools.cli import BrokenOffError, InputError, number_of_samples, print_warnings
from backlash_ros.tools.config import read_configuration, write_config
from backlash_ros.tools.runs.files import BAG, CONFIG_FILE, result_directory

ELSEWHERE = 'none'  # the parameter driver where somebody else starts it


class AxisPlan(NamedTuple):
    """One controller of a run, its parameters complete and checked; name: also its namespace.

    Of the parameters, samples is 0 without end, and driver empty for the simulated plant.
    """

    name: str
    parameters: Parameters
    out: Path
    record: bool

    @property
    def logs(self) -> Path:
        return self.out / 'logs'

    @property
    def waits(self) -> bool:
        """Whether it waits for somebody who may come at any time."""
        p = self.parameters
        return p.driver == ELSEWHERE or not p.autostart or bool(p.joints)

    def titled(self, text: str) -> str:
        return f'{self.name}: {text}' if self.name else text

    def process_name(self, node: str) -> str:
        return f'{self.name}/{node}' if self.name else node


class RunPlan(NamedTuple):
    """The controllers of a run. live_port: of the page in the browser, 0 for a free one."""

    axes: tuple[AxisPlan, ...]
    live_port: int | None = None


def prepare(options: argparse.Namespace) -> RunPlan:
    """Check all input, then make the result folders."""
    if ros_is_missing():
        raise BrokenOffError(ROS_MISSING)
    configuration = read_configuration(options.config, options.settings, options.seed)
    names = (options.axis,) if options.axis else configuration.axes or ('',)
    # Each node takes one of the places that discovery on one machine has; some stay for listeners.
    if len(names) > 7:
        raise InputError(f'{len(names)} axes are too many for one machine: at most 7')
    parameters: dict[str, Parameters] = {}
    users: dict[str, str] = {}
    for name in names:
        try:
            p = parameters[name] = _checked(configuration.of_controller(name), name, options)
        except (ParameterError, InputError) as error:
            error.args = (f'{name}: {error}' if name else str(error),)
            raise
        file = p.estimates.file
        if file and users.setdefault(file, name) != name:
            raise ParameterError(
                'estimates.file', file, f'is the file of {users[file]} and of {name}',
                f'give each axis one of its own, like --set {name}/estimates.file=...')
        if options.out is not None and (options.out / name / BAG).exists():
            raise InputError(f'--out={options.out}: holds a bag already, choose another folder')
    if options.unlimited and not any(p.driver for p in parameters.values()):
        raise InputError('--unlimited is about a driver: give --driver as well')
    for name, p in parameters.items():
        for joint in p.joint_names:
            print_warnings(': '.join(filter(None, ('bringup', name, joint))), p.of_joint(joint))
    # The nodes need a path that holds wherever it is read.
    out = result_directory(options.out).resolve()
    axes = tuple(AxisPlan(name, p, out / name, options.record) for name, p in parameters.items())
    for axis in axes:
        axis.logs.mkdir(parents=True, exist_ok=True)
        write_config(axis.parameters, axis.out / CONFIG_FILE)
    return RunPlan(axes, 0 if options.live and not options.live_port else options.live_port)


def _checked(p: Parameters, axis: str, options: argparse.Namespace) -> Parameters:
    """The parameters of an axis with the options, checked as far as is possible without running."""
    driver = (p.driver if options.driver is None else options.driver).strip()
    p = p.replaced({
        'lockstep': options.lockstep or p.lockstep, 'driver': driver.replace('{axis}', axis),
        'samples': 0 if options.duration == inf else number_of_samples(p, options.duration)})
    try:
        shlex.split(driver)
    except ValueError as error:
        raise ParameterError('driver', driver, 'is not a command', str(error)) from None
    for wrong, name, value, rule, cure in (
        (driver and p.lockstep, 'driver', driver, 'excludes lockstep',
         'a real plant does not wait for its control'),
        ('{axis}' in driver and not axis, 'driver', driver, 'names an axis',
         'list the axes in the parameter axes'),
        (p.joints and not driver, 'driver', driver, 'is empty, and nothing here simulates several '
         'joints', 'give --driver COMMAND, or none for one that you start yourself; '
         '`simulate --axis JOINT` simulates one of them'),
        (p.bag, 'bag', p.bag, 'is made by bringup', 'choose its folder with --out'),
    ):
        if wrong:
            raise ParameterError(name, value, rule, cure)
    for joint in p.joint_names:
        own = p.of_joint(joint)
        if driver and not options.unlimited and (missing := own.missing_limits):
            raise ParameterError(
                f'{joint}.{missing[0]}' if joint else missing[0], own[missing[0]],
                'is no limit, and a driver moves an actuator',
                f'set {", ".join(missing)}, or give --unlimited')
        build_controller(own)
    build_reference(p)
    if not driver:
        build_plant(p)
    return p


def plan_processes(plan: RunPlan, domain: int | None) -> list[list[Child]]:
    """The processes of a run by stages, which are to be stopped one after the other.

    A simulated plant stops first, so that no output stays without its answer. With a driver the
    controller goes first and the driver hears its last command. The recorder goes last.
    """
    stages: list[list[Child]] = [[], [], [], []]
    served: dict[str, list[AxisPlan]] = {}
    for axis in plan.axes:
        p = axis.parameters
        order = ('plant', 'reference', 'controller', 'recorder')
        if p.driver:
            order = ('controller', '', '' if p.joints else 'reference', 'recorder')
        for stage, node in zip(stages, order, strict=True):
            if node:
                stage.append(_child(axis, node, _arguments(axis, node), domain,
                                    p.timeout.ramp if node == 'controller' else 0.0))
        if p.driver and p.driver != ELSEWHERE:
            served.setdefault(p.driver, []).append(axis)
    for command, axes in served.items():
        name, logs = axes[0].process_name('driver'), axes[0].logs
        if len(axes) > 1:
            name = f'driver of {", ".join(axis.name for axis in axes)}'
        stages[1].append(Child(
            name, tuple(shlex.split(command)), logs / 'driver.log',
            foreign_environment(child_environment(logs, domain)), foreign=True,
            # The last command of the controller acts from the next sample of the driver on.
            settle_s=min(2.0 * max(axis.parameters.sample_period for axis in axes), 1.0)))
    if plan.live_port is not None:
        shown = [f'/{axis.name}' if axis.name else '/controller' for axis in plan.axes]
        stages[-1].append(_child(plan.axes[0], 'live', ['--port', str(plan.live_port), *shown],
                                 domain))
    return stages


def _child(
    axis: AxisPlan, node: str, arguments: Sequence[str], domain: int | None, grace_s: float = 0.0,
) -> Child:
    live = node == 'live'  # one for all axes
    return Child(
        node if live else axis.process_name(node),
        (sys.executable, '-m', f'backlash_ros.nodes.{node}', *arguments),
        axis.logs / f'{node}.log', child_environment(axis.logs, domain), axis.name,
        spectator=live, grace_s=grace_s)


def _arguments(axis: AxisPlan, node: str) -> list[str]:
    lockstep = axis.parameters.lockstep
    if node == 'recorder':
        # In YAML, whatever stands in the path.
        bag = str(axis.out / BAG).replace("'", "''") if axis.record else ''
        settings = ['-p', 'wait_for_publishers:=true', '-p', f"bag:='{bag}'"]
    else:
        # The loop and the recorder; in real time the reference follows plant_output as well, in
        # lockstep it follows /clock.
        settings = ['-p', f'wait_for_subscribers:={3 if node == "plant" and not lockstep else 2}']
    if axis.name:  # each axis has a time of its own
        settings += ['-r', f'__ns:=/{axis.name}', *['-r', '/clock:=clock'] * lockstep]
    return ['--ros-args', '--params-file', str(axis.out / CONFIG_FILE), *settings]
