"""Make a checked plan of a run from its options: its axes, and the processes of each."""

import argparse
import shlex
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.middleware import ROS_MISSING, ros_is_missing
from backlash_ros.tools import cli
from backlash_ros.tools.bringup.supervisor import Child
from backlash_ros.tools.cli import BrokenOffError, InputError
from backlash_ros.tools.config import read_configuration, write_config
from backlash_ros.tools.runs.files import BAG, CONFIG_FILE, result_directory

ELSEWHERE = 'none'  # value of the parameter driver if the user starts it
START_DEADLINE_S = 30.0  # for all processes to be ready, and for the first sample


def complain(message: str, name: str = 'bringup: ') -> None:
    print(f'{name}{message}', file=sys.stderr, flush=True)


@dataclass
class Axis:
    """One controller of a run and its progress; name: also its namespace.

    Its parameters are complete and checked: samples is 0 for an endless run, driver '' for the
    simulated plant. made: samples, counted from `first`. moved, next_line: times of the last
    progress and the next line, monotonic clock [s]. published: samples and messages by topic, once
    a simulated plant is done; heard: those that the recorder has."""

    name: str
    parameters: Parameters
    out: Path
    made: int = 0
    first: int = 0
    moved: float = field(default_factory=time.monotonic)
    next_line: float = 0.0
    published: Mapping[str, int] | None = None
    heard: Mapping[str, int] = field(default_factory=dict)

    @property
    def logs(self) -> Path:
        return self.out / 'logs'

    def titled(self, text: str) -> str:
        return f'{self.name}: {text}' if self.name else text

    def process_name(self, node: str) -> str:
        return f'{self.name}/{node}' if self.name else node

    @property
    def complete(self) -> bool:
        """Whether all samples were made and, if the plant is simulated, recorded.

        A driver does not say how many there were. What a stalled recorder has missed, the
        middleware sends again, every 3 s by default.
        """
        p = self.parameters
        if p.driver or self.published is None:
            return bool(p.driver) and 0 < p.samples <= self.made
        unheard = Counter(self.published) - Counter(self.heard)
        return not unheard or time.monotonic() > self.moved + 10.0

    def take(self, progress: Mapping[str, Any]) -> None:
        sample, p, now = progress['sample'], self.parameters, time.monotonic()
        if p.driver and self.made == 0:  # it may have been running before
            self.first = sample
        made = sample + 1 - self.first
        self.heard = {'samples': made, **progress.get('received', {})}
        if made <= self.made:
            return
        self.made, self.moved = made, now
        if now >= self.next_line:
            # Every 2 s at first, then less and less often: a run of days must not fill the disk.
            self.next_line = now + max(2.0, 0.05 * made * p.sample_period)
            words = [f'{made * p.sample_period:7.2f} s', f'{made}/{p.samples or "∞"}', *(
                f'{name} {cli.number(progress.get(name))}' for name in topics.BACKLASH
            ), f'lost {progress.get("lost", 0)}']
            complain(self.titled('  '.join(words)), '')

    def check_pace(self, unready: Sequence[Child] = ()) -> None:
        """Raise BrokenOffError if no samples come. unready: its processes that are not ready."""
        p = self.parameters
        # The user may start the driver, activate the controller or plan a motion at any time.
        waits = p.driver == ELSEWHERE or (unready and (not p.autostart or p.joints))
        # Long sample periods need more time.
        patience = 10.0 + 2.0 * p.sample_period if self.made else START_DEADLINE_S
        if self.complete or (waits and not self.made) or time.monotonic() < self.moved + patience:
            return
        what = f'not ready within {patience:g} s: {", ".join(child.name for child in unready)}' \
            if unready else f'no new sample for {patience:g} s'
        if self.made:
            what += f' after sample {self.first + self.made - 1}'
        if p.driver and self.made:
            # The controller itself handles a real plant that falls silent; complain once.
            self.moved = inf
            complain(self.titled(f'{what}, waiting for the driver'))
            return
        cure = ': does the driver listen to its command and publish its output? Where it needs ' \
               'longer, start it yourself (--driver none)' if p.driver else ''
        raise BrokenOffError('\n'.join([
            self.titled(f'{what}{cure}, see {self.logs}'),
            *(f'the end of {child.end_of_log()}' for child in unready)]))


def prepare(options: argparse.Namespace) -> list[Axis]:
    """Check all input, then make the folders of the results; returns the axes of the run."""
    if ros_is_missing():
        raise BrokenOffError(ROS_MISSING)
    configuration = read_configuration(options.config, options.settings, options.seed)
    names = (options.axis,) if options.axis else configuration.axes or ('',)
    # Discovery on one machine has a limited number of places: some are left for listeners.
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
    # The nodes need an absolute path.
    out = result_directory(options.out).resolve()
    axes = [Axis(name, p, out / name) for name, p in parameters.items()]
    for axis in axes:
        for joint in axis.parameters.joint_names:
            cli.print_warnings(': '.join(filter(None, ('bringup', axis.name, joint))),
                               axis.parameters.of_joint(joint))
        axis.logs.mkdir(parents=True, exist_ok=True)
        write_config(axis.parameters, axis.out / CONFIG_FILE)
    return axes


def _checked(p: Parameters, axis: str, options: argparse.Namespace) -> Parameters:
    """Parameters of an axis with the options applied, checked as far as possible before a run."""
    driver = (p.driver if options.driver is None else options.driver).strip()
    p = p.replaced({
        'lockstep': options.lockstep or p.lockstep, 'driver': driver.replace('{axis}', axis),
        'samples': 0 if options.duration == inf else cli.number_of_samples(p, options.duration)})
    try:
        shlex.split(driver)
    except ValueError as error:
        raise ParameterError('driver', driver, 'is not a command', str(error)) from None
    if driver and p.lockstep:
        raise ParameterError('driver', driver, 'excludes lockstep',
                             'a real plant does not wait for its control')
    if p.joints and not driver:
        raise ParameterError(
            'driver', driver, 'is empty, and nothing here simulates several joints',
            'give --driver COMMAND, or none for one that you start yourself; '
            '`simulate --axis JOINT` simulates one of them')
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


def stop_times(axes: Sequence[Axis]) -> tuple[float, float]:
    """How long to wait after each stage, and how much longer a process may take to end [s]."""
    parameters = [axis.parameters for axis in axes]
    # The last command of a controller acts only from the next sample of its driver on.
    settling = max(2.0 * p.sample_period * bool(p.driver) for p in parameters)
    return min(settling, 1.0), max(p.timeout.ramp for p in parameters)


def plan_processes(
    axes: Sequence[Axis], record: bool = True, live_port: int | None = None,
) -> list[list[Child]]:
    """The processes of a run in stages, in the order in which to stop them.

    A simulated plant stops first, so that every output is answered. A driver stops after the
    controller, so that it hears the last command. The recorder stops last. live_port: of the page
    in the browser, 0 for a free one, None for no page.
    """
    stages: list[list[Child]] = [[], [], [], []]
    served: dict[str, list[Axis]] = {}
    for axis in axes:
        p = axis.parameters
        order = ('plant', 'reference', 'controller', 'recorder')
        if p.driver:
            order = ('controller', '', '' if p.joints else 'reference', 'recorder')
        for stage, node in zip(stages, order, strict=True):
            if node:
                stage.append(_node(axis, node, record))
        if p.driver and p.driver != ELSEWHERE:
            served.setdefault(p.driver, []).append(axis)
    for command, sharing in served.items():
        name = sharing[0].process_name('driver') if len(sharing) == 1 else \
            f'driver of {", ".join(axis.name for axis in sharing)}'
        stages[1].append(Child(
            name, shlex.split(command), sharing[0].logs / 'driver.log', foreign=True))
    if live_port is not None:
        shown = [f'/{axis.name}' if axis.name else '/controller' for axis in axes]
        stages[-1].append(Child(
            'live',
            [sys.executable, '-m', 'backlash_ros.nodes.live', '--port', str(live_port), *shown],
            axes[0].logs / 'live.log', axes[0], spectator=True))
    return stages


def _node(axis: Axis, name: str, record: bool) -> Child:
    lockstep = axis.parameters.lockstep
    # Quoted for YAML, whatever the path contains.
    bag = str(axis.out / BAG).replace("'", "''") if record else ''
    # Subscribers of plant_output are controller and recorder and, in real time, the reference,
    # which follows /clock in lockstep.
    listeners = 3 if name == 'plant' and not lockstep else 2
    arguments = ['--params-file', str(axis.out / CONFIG_FILE), '-p', f"bag:='{bag}'",
                 '-p', 'wait_for_publishers:=true', '-p', f'wait_for_subscribers:={listeners}']
    if axis.name:  # each axis has simulated time of its own
        arguments += ['-r', f'__ns:=/{axis.name}', *['-r', '/clock:=clock'] * lockstep]
    return Child(
        axis.process_name(name),
        [sys.executable, '-m', f'backlash_ros.nodes.{name}', '--ros-args', *arguments],
        axis.logs / f'{name}.log', axis)
