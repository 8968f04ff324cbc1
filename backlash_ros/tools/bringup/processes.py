"""Child processes of the orchestrator: start them, listen to them, leave none of them behind.

Every child leads a process group of its own, so that a Ctrl-C of the terminal reaches the
orchestrator alone, which then stops the children in order, grandchildren included. A small
guardian process (`python -m backlash_ros.tools.bringup.processes`) holds the other end of a pipe:
when the orchestrator dies of whatever cause, the pipe closes and the guardian stops what is left.
Nothing here starts a thread: forking stays safe and a signal finds one loop to wake.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO

import backlash_ros
from backlash_ros.middleware.loopback import prefer_loopback

LOG_LINES = 10  # of a log that an error message quotes

# UDP ports of RTPS: a domain has 250; participant n takes 10 + 2 n and 11 + 2 n of them, and
# domains up to 101 lie below the ports that Linux hands out to others.
DOMAINS = 101
DOMAIN_0_PORT, PORTS_PER_DOMAIN = 7400, 250
PARTICIPANT_OFFSETS = range(10, 74, 2)  # as many as the discovery range LOCALHOST looks for
RESERVATION_OFFSET = 5

PROCESSES = Path('/proc')

# Set by ROS 2 wheels when they have prepared LD_LIBRARY_PATH for the Python that runs.
WHEELS_MARK, LIBRARY_PATH = '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'LD_LIBRARY_PATH'

# SIGINT lets a node end as by Ctrl-C; a recorder may need a while to close a large bag.
ESCALATION = ((signal.SIGINT, 10.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


class RunError(RuntimeError):
    """A run that was accepted and then failed; the message is for the user."""


@dataclass(frozen=True)
class ProcessPlan:
    """What to start.

    name: in messages. axis: that its events are about. foreign: no node of this package: all
    that it prints goes to its log. spectator: the run goes on without it. linger_s: the time that
    it is left alone when its turn to be stopped has come, because what was stopped before still
    has an effect on it. farewell_s: the time that it needs for its end beyond what any process
    gets.
    """

    name: str
    command: tuple[str, ...]
    log: Path
    environment: Mapping[str, str]
    axis: str = ''
    foreign: bool = False
    spectator: bool = False
    linger_s: float = 0.0
    farewell_s: float = 0.0


@dataclass(frozen=True)
class Event:
    """A JSON object that a process printed as a line of its stdout."""

    plan: ProcessPlan
    content: Mapping[str, object]

    @property
    def kind(self) -> str:
        """The word that says what happened: ready, progress, done, closed."""
        return str(self.content['event'])


@dataclass
class Child:
    """A started process; what it prints besides events goes to its log."""

    plan: ProcessPlan
    process: subprocess.Popen[bytes]
    stage: int
    unfinished_line: bytes = field(default=b'', repr=False)

    def group(self) -> list[int]:
        """The process group, as long as anything of it is left."""
        alive = self.process.poll() is None or group_exists(self.process.pid)
        return [self.process.pid] if alive else []

    def take(self, chunk: bytes) -> list[Event]:
        """Events of the lines that end in this chunk of stdout."""
        *lines, self.unfinished_line = (self.unfinished_line + chunk).split(b'\n')
        events = []
        for line in lines:
            content = _parse_event(line)
            if content is None:
                with self.plan.log.open('ab') as log:
                    log.write(line + b'\n')
            else:
                events.append(Event(self.plan, content))
        return events

    def end_of_log(self) -> str:
        """The last lines of the log, indented."""
        log = self.plan.log
        lines = log.read_text(encoding='utf-8', errors='replace').splitlines()
        quoted = ''.join(f'\n    {line}' for line in lines[-LOG_LINES:])
        return f'{log}:{quoted}' if quoted else f'{log} is empty'

    def describe_exit(self) -> str:
        """How the process ended, in words."""
        code = self.process.returncode
        if code is not None and code < 0:
            return f'killed by {signal.Signals(-code).name}'
        return f'exit code {code}'


def _parse_event(line: bytes) -> dict[str, object] | None:
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return content if isinstance(content, dict) and 'event' in content else None


class ProcessSupervisor:
    """Starts processes as a context manager and has stopped all of them when it is left.

    stages: in the order in which they are to be stopped, those of one stage together; all are
    started together. hurry: asked while stopping; once it says yes, nobody is given any more time.
    """

    def __init__(
        self, stages: Sequence[Sequence[ProcessPlan]], hurry: Callable[[], bool],
    ) -> None:
        self._stages, self._hurry = stages, hurry
        self._selector = selectors.DefaultSelector()
        self._guardian: subprocess.Popen[bytes] | None = None
        self.children: list[Child] = []

    def __enter__(self) -> ProcessSupervisor:
        try:
            self._guardian = subprocess.Popen(
                (sys.executable, '-m', 'backlash_ros.tools.bringup.processes'), bufsize=0,
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, env=with_source(os.environ),
                start_new_session=True,
            )
            for stage, plans in enumerate(self._stages):
                for plan in plans:
                    self._start(plan, stage)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    def events(self, timeout: float) -> list[Event]:
        """What the processes have said; waits up to timeout [s] for a first word."""
        found: list[Event] = []
        for key, _ in self._selector.select(timeout):
            child: Child = key.data
            chunk = os.read(key.fd, 65536)
            if not chunk:
                self._selector.unregister(key.fileobj)
            found += child.take(chunk)
        return found

    def ended(self) -> list[Child]:
        """Children whose process has ended, whether by itself or by a signal."""
        return [child for child in self.children if child.process.poll() is not None]

    def stop(self) -> list[Event]:
        """Stop one stage after the other, each child with all its group; returns last words."""
        last_words: list[Event] = []

        def listen() -> None:
            last_words.extend(self.events(0.02))

        for stage in range(len(self._stages)):
            children = [child for child in self.children if child.stage == stage]
            _linger(children, listen, self._hurry)
            farewell = max((child.plan.farewell_s for child in children), default=0.0)
            stop_groups(partial(_groups, children), listen, self._hurry, farewell)
            for child in children:
                self._tell_guardian(f'-{child.process.pid}\n')
        while self._selector.select(0.0):
            last_words += self.events(0.0)
        return last_words

    def _start(self, plan: ProcessPlan, stage: int) -> None:
        try:
            with plan.log.open('ab') as log:
                process = subprocess.Popen(
                    plan.command, stdin=subprocess.DEVNULL,
                    stdout=log if plan.foreign else subprocess.PIPE, stderr=log,
                    env=plan.environment, start_new_session=True,
                )
        except OSError as error:
            raise RunError(
                f'{plan.name} does not start: {plan.command[0]}: {error.strerror}'
            ) from error
        self._tell_guardian(f'+{process.pid} {stage} {plan.farewell_s}\n')
        child = Child(plan, process, stage)
        self.children.append(child)
        if process.stdout is not None:
            self._selector.register(process.stdout, selectors.EVENT_READ, child)

    def _close(self) -> None:
        self.stop()
        self._selector.close()
        for child in self.children:
            if child.process.stdout is not None:
                child.process.stdout.close()
        if self._guardian is not None:
            _pipe(self._guardian.stdin).close()
            self._guardian.wait()

    def _tell_guardian(self, line: str) -> None:
        if self._guardian is not None:
            with contextlib.suppress(BrokenPipeError):
                _pipe(self._guardian.stdin).write(line.encode())


def _groups(children: Sequence[Child]) -> list[int]:
    return [group for child in children for group in child.group()]


def _linger(
    children: Sequence[Child], wait: Callable[[], None], hurry: Callable[[], bool],
) -> None:
    times = [child.plan.linger_s for child in children if child.process.poll() is None]
    deadline = time.monotonic() + max(times, default=0.0)
    while time.monotonic() < deadline and not hurry():
        wait()


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    assert stream is not None
    return stream


def group_exists(group: int) -> bool:
    """Whether a process of this group is left; a zombie is none, for it may never be collected."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    if not PROCESSES.is_dir():
        return True
    # The leader first: only when it has gone all others must be looked through.
    return _lives_in(str(group), group) or any(
        _lives_in(entry.name, group) for entry in PROCESSES.iterdir() if entry.name.isdigit()
    )


def _lives_in(process: str, group: int) -> bool:
    try:
        stat = (PROCESSES / process / 'stat').read_text(encoding='utf-8', errors='replace')
    except OSError:
        return False
    # The name of the program stands in parentheses and may hold anything.
    state, _, its_group = stat.rpartition(')')[2].split()[:3]
    return int(its_group) == group and state not in ('Z', 'X')


def stop_groups(
    alive: Callable[[], Collection[int]], wait: Callable[[], None], hurry: Callable[[], bool],
    farewell_s: float = 0.0,
) -> None:
    """Signal process groups, ever more firmly, until none is alive or all means are used up.

    alive: the groups that are left. wait: passes a moment. hurry: yes skips to SIGKILL.
    farewell_s: how much longer the first signal may take than usual.
    """
    for number, usual in ESCALATION:
        patience = usual + farewell_s * (number == ESCALATION[0][0])
        if hurry() and number != signal.SIGKILL:
            continue
        for group in alive():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(group, number)
        deadline = time.monotonic() + patience
        while alive() and time.monotonic() < deadline:
            if hurry() and number != signal.SIGKILL:
                break
            wait()


def child_environment(log_folder: Path, domain: int | None) -> dict[str, str]:
    """Environment of nodes that report events and are confined to this machine.

    What the user has set stays. domain: ROS_DOMAIN_ID to set, None to leave it alone.
    """
    environment = with_source(os.environ)
    environment['BACKLASH_ROS_EVENTS'] = '1'
    environment['PYTHONUNBUFFERED'] = '1'
    if domain is not None:
        environment['ROS_DOMAIN_ID'] = str(domain)
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    prefer_loopback(environment)  # for drivers; the nodes of this package do so themselves
    environment.setdefault('ROS_LOG_DIR', str(log_folder / 'ros'))
    # The matrices are tiny: more threads would only take the processors from each other.
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        environment.setdefault(name, '1')
    return environment


def with_source(environment: Mapping[str, str]) -> dict[str, str]:
    """A copy in which Python finds this package, which need not be installed."""
    source = str(Path(backlash_ros.__file__).resolve().parents[1])
    # Behind the user's own entries it shadows nothing.
    paths = [entry for entry in environment.get('PYTHONPATH', '').split(os.pathsep) if entry]
    return {**environment, 'PYTHONPATH': os.pathsep.join([*paths, source])}


def foreign_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The same for a program that is no node of this package and may be of another Python.

    ROS 2 wheels have set variables for this Python alone, with which those of another one fail.
    """
    foreign = {
        name: value for name, value in environment.items()
        if name not in ('BACKLASH_ROS_EVENTS', WHEELS_MARK)
    }
    if WHEELS_MARK in environment and LIBRARY_PATH in environment:
        folders = environment[LIBRARY_PATH].split(os.pathsep)
        kept = [folder for folder in folders if not Path(folder).is_relative_to(sys.prefix)]
        foreign[LIBRARY_PATH] = os.pathsep.join(kept)
        if not kept:
            del foreign[LIBRARY_PATH]
    return foreign


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody on this machine uses, reserved as long as the context lasts.

    Every domain has UDP ports of its own (RTPS 2.5, 9.6.2). A domain is in use when the port of
    a participant is taken; a port that no participant ever uses reserves it, and the kernel
    gives that back whatever happens to this process. Raises RunError if all are in use.
    """
    # Starting at the process id spreads runs that start at the same moment.
    for i in range(DOMAINS):
        domain = 1 + (os.getpid() + i) % DOMAINS
        ports = DOMAIN_0_PORT + PORTS_PER_DOMAIN * domain
        with contextlib.ExitStack() as reservation:
            try:
                reservation.enter_context(_bound(ports + RESERVATION_OFFSET))
                for offset in PARTICIPANT_OFFSETS:
                    _bound(ports + offset).close()
            except OSError:
                continue
            yield domain
            return
    raise RunError(f'every ROS_DOMAIN_ID from 1 to {DOMAINS} is in use here: set one yourself')


def _bound(port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(('', port))
    except OSError:
        bound.close()
        raise
    return bound


def guard(orders: Iterable[str]) -> None:
    """Read `+GROUP STAGE FAREWELL` and `-GROUP` until the end, then stop what stays.

    One stage goes after the other. The end comes when the orchestrator closes the pipe or the
    kernel does it after its death.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    stages: dict[int, int] = {}
    farewells: dict[int, float] = {}
    for order in orders:
        group, *more = order[1:].split()
        if order[0] == '+':
            stages[int(group)], farewells[int(group)] = int(more[0]), float(more[1])
        else:
            stages.pop(int(group), None)
    for now in sorted(set(stages.values())):
        groups = [group for group, stage in stages.items() if stage == now]
        stop_groups(
            partial(_existing, groups), lambda: time.sleep(0.02), lambda: False,
            max(farewells[group] for group in groups),
        )


def _existing(groups: Sequence[int]) -> list[int]:
    return [group for group in groups if group_exists(group)]


if __name__ == '__main__':
    guard(sys.stdin)
