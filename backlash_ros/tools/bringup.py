"""One command for a whole run: start the nodes, watch them, stop them, report."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.errors import ParameterError
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools import command_line, processes
from backlash_ros.tools.command_line import DONE, FAILED, OptionParser, print_warnings
from backlash_ros.tools.configuration import effective_parameters, write_config
from backlash_ros.tools.errors import InputError
from backlash_ros.tools.processes import Event, ProcessPlan, ProcessSupervisor, RunError
from backlash_ros.tools.progress import ProgressDisplay, number
from backlash_ros.tools.results import CONFIG, result_directory

DEFAULT_DURATION_S = 10.0
READY_DEADLINE_S = 30.0
LATE_DEADLINE_S = 10.0  # that a run in real time may take longer than it should
STALL_DEADLINE_S = 10.0  # without a new sample
LISTEN_S = 0.1  # between two looks at signals, deadlines and dead processes

BAG, LOGS = 'bag', 'logs'

EPILOG = """
exit codes: 0 done, 2 bad input, 1 anything else (a process died, nothing moves, interrupted).

A first Ctrl-C (SIGTERM, SIGHUP) stops all processes in order and reports what was recorded, a
second one kills them at once. If bringup itself is killed, a guardian process stops the others.

environment: the processes inherit it. Unless you set them yourself,
  ROS_AUTOMATIC_DISCOVERY_RANGE  is LOCALHOST: nothing leaves this machine
  ROS_DOMAIN_ID                  is one that nobody uses on this machine, so that two runs never
                                 hear each other; it is printed, so that you can listen in
  ROS_LOG_DIR                    is DIR/logs/ros
  OMP_NUM_THREADS and its like   are 1
"""


@dataclass(frozen=True)
class RunPlan:
    """What is to be run; `parameters` are complete and checked, `out` exists."""

    parameters: Parameters
    out: Path
    record: bool

    @property
    def samples(self) -> int:
        """Samples of the whole run."""
        return self.parameters.integer('samples')

    @property
    def sample_period(self) -> float:
        """T [s]."""
        return self.parameters.real('sample_period')

    @property
    def bag(self) -> Path:
        """Folder of the bag."""
        return self.out / BAG

    @property
    def logs(self) -> Path:
        """Folder of the logs."""
        return self.out / LOGS


class StopRequests:
    """Counts SIGINT, SIGTERM and SIGHUP as long as the context lasts, instead of dying of them."""

    def __init__(self) -> None:
        self.count = 0
        self.last = ''
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequests:
        for caught in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # Under nohup a hang-up stays ignored.
            if caught != signal.SIGHUP or signal.getsignal(caught) is not signal.SIG_IGN:
                self._before[caught] = signal.signal(caught, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for caught, handler in self._before.items():
            signal.signal(caught, handler)

    def insist(self) -> bool:
        """Whether there was a second request."""
        return self.count > 1

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.last = signal.Signals(number).name


class Run:
    """A run in progress: what the processes have said so far, and how long to wait for more.

    failure: what went wrong, empty as long as nothing did.
    """

    def __init__(
        self, plan: RunPlan, supervisor: ProcessSupervisor, requests: StopRequests,
        display: ProgressDisplay,
    ) -> None:
        self._plan, self._supervisor = plan, supervisor
        self._requests, self._display = requests, display
        self._ready: set[str] = set()
        self._last_sample = -1
        self._last_move = 0.0
        self._standing_still = False
        self._done = False
        self.failure = ''

    @property
    def has_samples(self) -> bool:
        """Whether at least one sample went round the loop."""
        return self._last_sample >= 0

    def execute(self) -> None:
        """Let the plant make all samples, then stop everything; sets failure."""
        try:
            self._wait(lambda: not self._missing(), READY_DEADLINE_S, self._explain_missing)
            self._make_samples()
            self._standing_still = False
            self._wait(
                self._caught_up, STALL_DEADLINE_S, lambda: 'the recorder does not catch up'
            )
        except RunError as error:
            # Said before the processes are stopped, which may take a while.
            self._fail(str(error))
        for event in self._supervisor.stop():
            self._note(event)
        if not self.failure:
            self._fail('\n'.join(
                f'{child.plan.name} did not stop cleanly ({child.describe_exit()}), the end of '
                f'{child.end_of_log()}'
                for child in self._supervisor.children if child.process.returncode != 0
            ))

    def _fail(self, message: str) -> None:
        self.failure = message
        if message:
            self._display.close()
            complain(message)

    def _make_samples(self) -> None:
        self._last_move = time.monotonic()
        duration = self._plan.samples * self._plan.sample_period
        deadline = self._last_move + duration + LATE_DEADLINE_S
        lockstep = self._plan.parameters.flag('lockstep')
        # A plant of long sample periods may take its time.
        patience = STALL_DEADLINE_S + 2.0 * self._plan.sample_period
        while not self._done:
            self._listen()
            if time.monotonic() > self._last_move + patience:
                at = f' after sample {self._last_sample}' if self.has_samples else ''
                raise RunError(f'no new sample for {patience:g} s{at}, see {self._plan.logs}')
            if time.monotonic() > deadline and not lockstep:
                raise RunError(
                    f'only {self._last_sample + 1} of {self._plan.samples} samples, '
                    f'{LATE_DEADLINE_S:g} s after the end was due, see {self._plan.logs}'
                )

    def _caught_up(self) -> bool:
        # The last outputs may have been lost on purpose: then the recorder says the same again.
        return self._last_sample >= self._plan.samples - 1 or self._standing_still

    def _wait(
        self, condition: Callable[[], bool], patience: float, explain: Callable[[], str],
    ) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            self._listen()
            if time.monotonic() > deadline and not condition():
                raise RunError(explain())

    def _listen(self) -> None:
        for event in self._supervisor.events(LISTEN_S):
            self._note(event)
        if self._requests.count:
            raise RunError(f'interrupted by {self._requests.last}, stopping')
        dead = self._supervisor.ended()
        if dead:
            raise RunError('\n'.join(
                f'{child.plan.name} died ({child.describe_exit()}), the end of '
                f'{child.end_of_log()}'
                for child in dead
            ))

    def _note(self, event: Event) -> None:
        if event.kind == 'ready':
            self._ready.add(event.process)
        elif event.kind == 'done':
            self._done = True
        elif event.kind == 'progress':
            sample = number(event.content, 'sample')
            moved = isfinite(sample) and int(sample) > self._last_sample
            self._standing_still = not moved
            if moved:
                self._last_sample, self._last_move = int(sample), time.monotonic()
                self._display.show(event.content)

    def _missing(self) -> list[str]:
        names = [child.plan.name for child in self._supervisor.children]
        return [name for name in names if name not in self._ready]

    def _explain_missing(self) -> str:
        missing = self._missing()
        logs = '\n'.join(
            f'the end of {child.end_of_log()}' for child in self._supervisor.children
            if child.plan.name in missing
        )
        return f'not ready within {READY_DEADLINE_S:g} s: {", ".join(missing)}\n{logs}'


def complain(message: str) -> None:
    """Say on stderr what went wrong."""
    print(f'bringup: {message}', file=sys.stderr, flush=True)


def plan_processes(plan: RunPlan) -> tuple[ProcessPlan, ...]:
    """The processes of a run in the order in which they are to be stopped.

    The recorder goes last and so has everything that the others have said.
    """
    listeners = {'wait_for_subscribers': '2'}  # the loop and the recorder
    recorder = {
        'wait_for_publishers': 'true', 'bag': _quoted(plan.bag) if plan.record else "''",
    }
    # In real time the reference follows plant_output as well, in lockstep it follows /clock.
    outputs = '2' if plan.parameters.flag('lockstep') else '3'
    return (
        _node('plant', plan, {'wait_for_subscribers': outputs}),
        _node('reference', plan, listeners),
        _node('controller', plan, listeners),
        _node('recorder', plan, recorder),
    )


def _node(name: str, plan: RunPlan, own: Mapping[str, str]) -> ProcessPlan:
    command = [
        sys.executable, '-m', f'backlash_ros.nodes.{name}', '--ros-args',
        '--params-file', str(plan.out / CONFIG),
    ]
    for parameter, value in own.items():
        command += ['-p', f'{parameter}:={value}']
    return ProcessPlan(name, tuple(command))


def _quoted(path: Path) -> str:
    """A text in YAML, whatever stands in it."""
    return "'" + str(path).replace("'", "''") + "'"


def prepare(options: argparse.Namespace) -> RunPlan:
    """Check all input, then make the result folder; raises ParameterError or InputError."""
    parameters = effective_parameters(options.config, options.settings, options.seed)
    parameters = parameters.replaced({
        'lockstep': options.lockstep or parameters.flag('lockstep'),
        'samples': _samples(parameters, options.duration),
    })
    if parameters.word('bag'):
        raise ParameterError(
            'bag', parameters.word('bag'), 'is made by bringup', 'choose its folder with --out'
        )
    build_controller(parameters)
    build_plant(parameters)
    build_reference(parameters)
    print_warnings('bringup', parameters)
    if options.out is not None and (options.out / BAG).exists():
        raise InputError(f'--out={options.out}: holds a bag already, choose another folder')
    # The nodes need a path that holds wherever it is read.
    plan = RunPlan(parameters, result_directory(options.out).resolve(), options.record)
    try:
        plan.logs.mkdir(exist_ok=True)
        write_config(parameters, plan.out / CONFIG)
    except OSError as error:
        raise InputError(f'{plan.out}: cannot be written: {error.strerror}') from None
    return plan


def _samples(parameters: Parameters, duration: float | None) -> int:
    samples = parameters.integer('samples')
    if duration is None and samples > 0:
        return samples
    return command_line.whole_samples(
        DEFAULT_DURATION_S if duration is None else duration, parameters.real('sample_period')
    )


def perform(plan: RunPlan) -> int:
    """Run and report; returns the exit code."""
    try:
        with ExitStack() as stack:
            requests = stack.enter_context(StopRequests())
            environment = processes.child_environment(plan.logs, _announced_domain(stack))
            display = stack.enter_context(
                closing(ProgressDisplay(plan.samples, plan.sample_period, sys.stderr))
            )
            supervisor = stack.enter_context(ProcessSupervisor(
                plan_processes(plan), plan.logs, environment, requests.insist
            ))
            run = Run(plan, supervisor, requests, display)
            run.execute()
    except RunError as error:
        complain(str(error))
        return FAILED
    reported = run.has_samples and report(plan)
    return DONE if reported and not run.failure else FAILED


def _announced_domain(stack: ExitStack) -> int | None:
    if os.environ.get('ROS_DOMAIN_ID'):
        return None
    domain = stack.enter_context(processes.free_domain())
    discovery = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    print(
        f'to listen in: export ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE={discovery}',
        flush=True,
    )
    return domain


def report(plan: RunPlan) -> bool:
    """Write and print what came out; returns whether that worked."""
    if not plan.record:
        print(f'no bag and no report (--no-record), logs in {plan.logs}')
        return True
    # Drawing libraries take a second to load: not before bad input is refused.
    from backlash_ros.tools.report import PAGE, report_bag
    from backlash_ros.tools.simulate import run_table
    try:
        summary = report_bag(plan.bag, plan.out, plan.parameters)
    except (InputError, OSError) as error:
        complain(f'no report: {error}')
        return False
    print(run_table(summary))
    facts = f'{summary["samples"]} samples, {summary["lost_samples"]} lost'
    latency = summary['loop_latency_ms']
    if latency is not None:
        facts += f', y to v within {latency["p50"]:.2f} ms (p50), {latency["p99"]:.2f} ms (p99)'
    print(facts)
    print(f'report: {plan.out / PAGE}')
    return True


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Options of the command line; raises InputError."""
    parser = OptionParser(
        prog='bringup', description=__doc__, epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command_line.add_common_options(parser)
    parser.add_argument(
        '--duration', type=float, metavar='SECONDS',
        help=f'length of the run (default: the parameter samples, or {DEFAULT_DURATION_S:g} s)',
    )
    parser.add_argument(
        '--lockstep', action='store_true',
        help='as fast as the machine allows, every sample waiting for its control, '
             'instead of real time',
    )
    parser.add_argument(
        '--record', action=argparse.BooleanOptionalAction, default=True,
        help='record a bag and write a report from it',
    )
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    code = DONE

    def bringup() -> None:
        nonlocal code
        code = perform(prepare(parse_options(arguments)))

    return command_line.run_tool('bringup', bringup) or code


if __name__ == '__main__':
    sys.exit(main())
