"""What a run consists of: its axes, and the processes of each."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from backlash_ros.core.parameters import Parameters, missing_limits
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.tools.bringup.environment import child_environment, foreign_environment
from backlash_ros.tools.bringup.processes import ProcessPlan
from backlash_ros.tools.runs.files import CONFIG

BAG, LOGS = 'bag', 'logs'
DRIVER, ELSEWHERE = 'driver', 'none'
LIVE = 'live'
AXIS_MARK = '{axis}'


@dataclass(frozen=True)
class AxisPlan:
    """One loop of a run; its parameters are complete and checked, its folder exists.

    name: also its namespace, empty for a run without axes.
    """

    name: str
    parameters: Parameters
    out: Path
    record: bool

    @property
    def samples(self) -> int:
        """Samples of the whole run, 0 for a run without end."""
        return self.parameters.get_int('samples')

    @property
    def sample_period(self) -> float:
        """T [s]."""
        return self.parameters.get_float('sample_period')

    @property
    def bag(self) -> Path:
        """Folder of the bag."""
        return self.out / BAG

    @property
    def logs(self) -> Path:
        """Folder of the logs."""
        return self.out / LOGS

    @property
    def has_driver(self) -> bool:
        """Whether something else stands in the place of the simulated plant."""
        return bool(self.parameters.get_str(DRIVER))

    @property
    def driver_is_elsewhere(self) -> bool:
        """Whether somebody else starts the driver."""
        return self.parameters.get_str(DRIVER) == ELSEWHERE

    @property
    def is_managed(self) -> bool:
        """Whether somebody else activates the controller."""
        return not self.parameters.get_bool('autostart')

    def titled(self, text: str) -> str:
        """The text, with the name of the axis where there are axes."""
        return f'{self.name}: {text}' if self.name else text

    def process_name(self, node: str) -> str:
        """Name of one of its processes in messages."""
        return f'{self.name}/{node}' if self.name else node


@dataclass(frozen=True)
class RunPlan:
    """All that runs together: one loop without a name, or one for each axis.

    live_port: of the page in the browser, 0 for a free one, None without a page.
    """

    axes: tuple[AxisPlan, ...]
    out: Path
    live_port: int | None = None

    @property
    def endless(self) -> bool:
        """Whether only the user ends it."""
        return any(axis.samples == 0 for axis in self.axes)

    @property
    def awaits_driver(self) -> bool:
        """Whether a driver is started by somebody else."""
        return any(axis.driver_is_elsewhere for axis in self.axes)


def check_driver(axis: str, parameters: Parameters) -> Parameters:
    """The set with the name of the axis in the command of its driver; raises ParameterError."""
    text = parameters.get_str(DRIVER).strip()
    if not text:
        return parameters.replaced({DRIVER: ''})
    try:
        shlex.split(text)
    except ValueError as error:
        raise ParameterError(DRIVER, text, 'is not a command', str(error)) from None
    if parameters.get_bool('lockstep'):
        raise ParameterError(
            DRIVER, text, 'excludes lockstep', 'a real plant does not wait for its control'
        )
    if AXIS_MARK in text and not axis:
        raise ParameterError(DRIVER, text, 'names an axis', 'list the axes in the parameter axes')
    return parameters.replaced({DRIVER: text.replace(AXIS_MARK, axis)})


def check_limits(parameters: Parameters) -> None:
    """Raise ParameterError where nothing limits v."""
    missing = missing_limits(parameters)
    if missing:
        raise ParameterError(
            missing[0],
            parameters.get_float(missing[0]),
            'is no limit, and a driver moves an actuator',
            f'set {", ".join(missing)}, or give --unlimited',
        )


def plan_processes(plan: RunPlan, domain: int | None) -> list[list[ProcessPlan]]:
    """The processes of a run by stages, which are to be stopped one after the other.

    A simulated plant stops first, so that no output stays without its answer. With a driver the
    controller goes first and the driver hears its last command. The recorder goes last and so
    has everything that the others have said. domain: ROS_DOMAIN_ID to set, None to leave it alone.
    """
    stages: list[list[ProcessPlan]] = [[], [], [], []]
    for axis in plan.axes:
        environment = child_environment(axis.logs, domain)
        nodes = _nodes(axis, environment)
        first, second, third = (
            ('controller', DRIVER, 'reference') if axis.has_driver
            else ('plant', 'reference', 'controller')
        )
        for stage, name in zip(stages, (first, second, third, 'recorder'), strict=True):
            if name in nodes:
                stage.append(nodes[name])
    stages[1] += _drivers(plan, domain)
    if plan.live_port is not None:
        stages[-1].append(_page(plan, plan.live_port, domain))
    return stages


def _page(plan: RunPlan, port: int, domain: int | None) -> ProcessPlan:
    """The page in the browser, which shows all axes."""
    logs = plan.axes[0].logs
    shown = [f'/{axis.name}' if axis.name else '/controller' for axis in plan.axes]
    command = (
        sys.executable, '-m', 'backlash_ros.nodes.live.command', '--port', str(port), *shown
    )
    return ProcessPlan(
        LIVE, command, logs / f'{LIVE}.log', child_environment(logs, domain),
        plan.axes[0].name, spectator=True,
    )


def _nodes(axis: AxisPlan, environment: Mapping[str, str]) -> dict[str, ProcessPlan]:
    listeners = {'wait_for_subscribers': '2'}  # the loop and the recorder
    own = {
        'reference': listeners, 'controller': listeners,
        'recorder': {
            'wait_for_publishers': 'true', 'bag': _quoted(axis.bag) if axis.record else "''",
        },
    }
    if not axis.has_driver:
        # In real time the reference follows plant_output as well, in lockstep it follows /clock.
        outputs = '2' if axis.parameters.get_bool('lockstep') else '3'
        own['plant'] = {'wait_for_subscribers': outputs}
    return {
        name: ProcessPlan(
            axis.process_name(name), _node_command(axis, name, values),
            axis.logs / f'{name}.log', environment, axis.name,
            # The controller may end with a ramp, and then saves what it has learned.
            farewell_s=axis.parameters.get_float('timeout.ramp') if name == 'controller' else 0.0,
        )
        for name, values in own.items()
    }


def _node_command(axis: AxisPlan, node: str, own: Mapping[str, str]) -> tuple[str, ...]:
    command = [
        sys.executable, '-m', f'backlash_ros.nodes.{node}', '--ros-args',
        '--params-file', str(axis.out / CONFIG),
    ]
    for parameter, value in own.items():
        command += ['-p', f'{parameter}:={value}']
    if axis.name:
        command += ['-r', f'__ns:=/{axis.name}']
    if axis.name and axis.parameters.get_bool('lockstep'):
        command += ['-r', '/clock:=clock']  # each axis has a time of its own
    return tuple(command)


def _drivers(plan: RunPlan, domain: int | None) -> list[ProcessPlan]:
    """The drivers to start; axes with the very same command have one driver together."""
    served: dict[tuple[str, ...], list[AxisPlan]] = {}
    for axis in plan.axes:
        if axis.has_driver and not axis.driver_is_elsewhere:
            served.setdefault(tuple(shlex.split(axis.parameters.get_str(DRIVER))), []).append(axis)
    return [_driver(plan, command, axes, domain) for command, axes in served.items()]


def _driver(
    plan: RunPlan, command: tuple[str, ...], axes: Sequence[AxisPlan], domain: int | None,
) -> ProcessPlan:
    name, log = axes[0].process_name(DRIVER), axes[0].logs / f'{DRIVER}.log'
    if len(axes) > 1:
        names = [axis.name for axis in axes]
        name, log = f'{DRIVER} of {", ".join(names)}', plan.out / LOGS / f'{"_".join(names)}.log'
    # The last command of the controller acts from the next sample of the driver on.
    linger = 2.0 * max(axis.sample_period for axis in axes)
    return ProcessPlan(
        name, command, log,
        foreign_environment(child_environment(log.parent, domain)),
        foreign=True, linger_s=min(linger, 1.0),
    )


def _quoted(path: Path) -> str:
    """A text in YAML, whatever stands in it."""
    return "'" + str(path).replace("'", "''") + "'"
