"""Child processes: started together, listened to, stopped in order, none of them left behind.

Every child leads a process group of its own, which no Ctrl-C of the terminal reaches. When the
supervisor dies, a pipe closes, and this module as a program, the guardian, stops what is left.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

import backlash_ros
from backlash_ros.middleware import prefer_loopback
from backlash_ros.tools.cli import ONE_THREAD, BrokenOffError

# SIGINT lets a node end as by Ctrl-C; a recorder may need a while to close a large bag.
ESCALATION = ((signal.SIGINT, 10.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


def child_environment(log_folder: Path, domain: int | str) -> dict[str, str]:
    """Environment of nodes on this machine; what the user has set stays, except for the domain."""
    environment = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(log_folder / 'ros'),
        **ONE_THREAD, **with_source(os.environ), 'BACKLASH_ROS_EVENTS': '1',
        'PYTHONUNBUFFERED': '1', 'ROS_DOMAIN_ID': str(domain)}
    prefer_loopback(environment)  # for drivers; the nodes of this package do so themselves
    return environment


def with_source(environment: Mapping[str, str]) -> dict[str, str]:
    """A copy in which Python finds this package, which need not be installed."""
    source = str(Path(backlash_ros.__file__).resolve().parents[1])
    # Behind the user's own entries it shadows nothing.
    paths = filter(None, [*environment.get('PYTHONPATH', '').split(os.pathsep), source])
    return {**environment, 'PYTHONPATH': os.pathsep.join(paths)}


def foreign_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The same for another program: what ROS 2 wheels have set is for this Python alone."""
    foreign = {name: value for name, value in environment.items() if name != 'BACKLASH_ROS_EVENTS'}
    if foreign.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None):
        foreign['LD_LIBRARY_PATH'] = os.pathsep.join(
            folder for folder in foreign.get('LD_LIBRARY_PATH', '').split(os.pathsep)
            if folder and not Path(folder).is_relative_to(sys.prefix))
    return foreign


@contextmanager
def free_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody on this machine uses, reserved as long as the context lasts.

    Domain d has the UDP ports from 7400 + 250 d on, of which participant n takes 10 + 2 n and
    11 + 2 n (RTPS 2.5, 9.6.2); a port that no participant ever uses reserves it.
    """
    # These lie below the ports that Linux hands out to others. Starting at the process id spreads
    # runs that start at the same moment.
    for domain in (1 + (os.getpid() + i) % 101 for i in range(101)):
        port = 7400 + 250 * domain
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reservation:
            try:
                reservation.bind(('', port + 5))
                # As many participants as the discovery range LOCALHOST looks for.
                for of_participant in range(port + 10, port + 74, 2):
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                        probe.bind(('', of_participant))
            except OSError:
                continue
            yield domain
            return
    raise BrokenOffError(
        'every ROS_DOMAIN_ID from 1 to 101 is in use on this machine: set one yourself')


@dataclass(eq=False)
class Child:
    """A process; axis: what its events are about.

    foreign: no node of this package, which tells nothing but by its log. spectator: once it is
    ready, which it says, the run goes on without it.
    """

    name: str
    command: Sequence[str]
    log: Path
    axis: Any = None
    foreign: bool = False
    spectator: bool = False
    ready: bool = False
    process: subprocess.Popen[bytes] = field(init=False)

    def start(self, environment: Mapping[str, str]) -> None:
        """Raises BrokenOffError for a program that cannot be started."""
        # A node lets them through when it knows what to do with them: see nodes/__init__.py.
        held_back = () if self.foreign else (signal.SIGINT, signal.SIGTERM)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, held_back)
        try:
            with self.log.open('ab') as log:
                self.process = subprocess.Popen(
                    self.command, stdin=subprocess.DEVNULL, stderr=log, start_new_session=True,
                    stdout=log if self.foreign else subprocess.PIPE,
                    env=foreign_environment(environment) if self.foreign else environment)
        except OSError as error:
            raise BrokenOffError(f'{self.name} does not start: {self.command[0]}: '
                                 f'{error.strerror}') from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def pass_on(self, events: 'SimpleQueue[tuple[Child, dict[str, Any]]]') -> None:
        """Read its output: the events of nodes/runtime/process.py go on, all else is logged."""
        assert self.process.stdout is not None
        with self.process.stdout as lines, self.log.open('ab', 0) as log:
            for line in lines:
                # Whoever is killed may leave half a line.
                if line.startswith(b'{"event": ') and line.endswith(b'}\n'):
                    events.put((self, json.loads(line)))
                else:
                    log.write(line)

    def describe_end(self, what: str, further: str = '') -> str:
        code = self.process.returncode
        end = f'killed by {signal.Signals(-code).name}' if code < 0 else f'exit code {code}'
        return f'{self.name} {what} ({end}){further}, the end of {self.end_of_log()}'

    def end_of_log(self) -> str:
        lines = self.log.read_text(encoding='utf-8', errors='replace').splitlines()
        quoted = ''.join(f'\n    {line}' for line in lines[-10:])
        return f'{self.log}:{quoted}' if quoted else f'{self.log} is empty'


class ProcessSupervisor:
    """Starts processes as a context manager and has stopped all of them when it is left.

    stages: in the order in which they are to be stopped. hurry: whether nobody gets any more time.
    pause_s: after the end of a stage. grace_s: beyond the usual time for an end.
    """

    def __init__(
        self, stages: Sequence[Sequence[Child]], environment: Mapping[str, str],
        hurry: Callable[[], bool] = lambda: False, pause_s: float = 0.0, grace_s: float = 0.0,
    ) -> None:
        self._stages, self._environment, self._hurry = stages, environment, hurry
        self._times = pause_s, grace_s
        self.children: list[Child] = []
        self._readers: list[Thread] = []
        self._events = SimpleQueue[tuple[Child, dict[str, Any]]]()

    def __enter__(self) -> 'ProcessSupervisor':
        self._guardian = subprocess.Popen(
            (sys.executable, '-m', __name__), bufsize=0, stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL, env=with_source(os.environ), start_new_session=True)
        assert self._guardian.stdin is not None
        try:
            for child in chain(*self._stages):
                child.start(self._environment)
                self.children.append(child)
                with suppress(BrokenPipeError):
                    self._guardian.stdin.write(
                        f'{json.dumps([self._groups(), *self._times])}\n'.encode())
                if not child.foreign:
                    self._readers.append(
                        Thread(target=child.pass_on, args=(self._events,), daemon=True))
                    self._readers[-1].start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._guardian.communicate()

    def events(self, timeout: float) -> Iterator[tuple[Child, dict[str, Any]]]:
        """What the processes have said; waits up to timeout [s] for a first word."""
        with suppress(Empty):
            yield self._events.get(timeout=timeout)
            while True:
                yield self._events.get_nowait()

    def stop(self) -> None:
        """Stop one stage after the other, each child with all its group."""
        stop_stages(self._groups(), *self._times, self._hurry)
        for child in self.children:
            child.process.poll()
        for reader in self._readers:
            reader.join(1.0)  # whoever left the group may keep the output open

    def _groups(self) -> list[list[int]]:
        """The process groups of each stage, as far as they have been started."""
        return [[child.process.pid for child in stage if child in self.children]
                for stage in self._stages]


def stop_stages(
    stages: Sequence[Sequence[int]], pause_s: float, grace_s: float,
    hurry: Callable[[], bool] = lambda: False,
) -> None:
    """Signal process groups, stage by stage and ever more firmly, until none is alive.

    hurry: skip to SIGKILL. The rest as in ProcessSupervisor.
    """
    for groups in filter(living, stages):
        for number, patience_s in ESCALATION:
            last = number == signal.SIGKILL
            deadline = time.monotonic() + patience_s + grace_s * (number == signal.SIGINT)
            if last or not hurry():
                for group in living(groups):
                    with suppress(ProcessLookupError, PermissionError):
                        os.killpg(group, number)
            while (last or not hurry()) and time.monotonic() < deadline and living(groups):
                time.sleep(0.02)
        time.sleep(pause_s)


def living(groups: Sequence[int]) -> set[int]:
    """The groups with a process left; a zombie is none, for it may never be collected."""
    found = set()
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):  # gone meanwhile
            text = stat.read_text(encoding='utf-8', errors='replace')
            # The name of the program stands in parentheses and may hold anything: proc_pid_stat(5).
            state, _, group, *others = text.rpartition(')')[2].split()
            # Where only the main thread has ended, the process is shown as a zombie with threads.
            if state not in 'XZ' or (state == 'Z' and others[14] != '1'):
                found.add(int(group))
    return found.intersection(groups)


if __name__ == '__main__':  # the guardian
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # What is to be stopped stands in the last line, which is complete once the supervisor has gone.
    if told := sys.stdin.read().splitlines():
        stop_stages(*json.loads(told[-1]))
