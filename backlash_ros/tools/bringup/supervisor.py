"""Start child processes together, take their events, stop them in order, leave none behind.

Every child leads a process group of its own, which no Ctrl-C of the terminal reaches. If the
supervisor dies, a pipe closes, and the guardian, this module as a program, stops what is left.
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
from backlash_ros.tools.cli import BrokenOffError

# SIGINT ends a node as Ctrl-C does; a recorder may need a while to close a large bag.
ESCALATION = ((signal.SIGINT, 10.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


def child_environment(log_folder: Path, domain: int | str) -> dict[str, str]:
    """Environment of nodes on this machine; the user's settings stay, except for the domain."""
    environment = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(log_folder / 'ros'),
        **with_source(os.environ), 'BACKLASH_ROS_EVENTS': '1', 'PYTHONUNBUFFERED': '1',
        'ROS_DOMAIN_ID': str(domain)}
    prefer_loopback(environment)  # for drivers; the nodes of this package do so themselves
    return environment


def with_source(environment: Mapping[str, str]) -> dict[str, str]:
    """A copy with which Python finds this package, even if it is not installed."""
    source = str(Path(backlash_ros.__file__).resolve().parents[1])
    # Behind the user's own entries it shadows nothing.
    paths = filter(None, [*environment.get('PYTHONPATH', '').split(os.pathsep), source])
    return {**environment, 'PYTHONPATH': os.pathsep.join(paths)}


def foreign_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for a foreign program, without what the ROS 2 wheels set for this Python."""
    foreign = {name: value for name, value in environment.items() if name != 'BACKLASH_ROS_EVENTS'}
    if foreign.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None):
        foreign['LD_LIBRARY_PATH'] = os.pathsep.join(
            folder for folder in foreign.get('LD_LIBRARY_PATH', '').split(os.pathsep)
            if folder and not Path(folder).is_relative_to(sys.prefix))
    return foreign


@contextmanager
def free_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody on this machine uses, reserved while the context lasts.

    Domain d has the UDP ports from 7400 + 250 d on, of which participant n takes 10 + 2 n and
    11 + 2 n (RTPS 2.5, 9.6.2). It is reserved by a port that no participant ever uses.
    """
    # Ports of these domains lie below those that Linux assigns freely. The process id spreads runs
    # that start at the same moment.
    for domain in (1 + (os.getpid() + i) % 101 for i in range(101)):
        port = 7400 + 250 * domain
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reservation:
            try:
                reservation.bind(('', port + 5))
                # For as many participants as the discovery range LOCALHOST covers.
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
    """A process. axis: the axis that its events are about.

    foreign: it is no node of this package and sends no events. spectator: once it is ready, the run
    goes on even if it dies.
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
        """Start the process; raises BrokenOffError if the program cannot be started."""
        # A node unblocks these signals once it can handle them: see nodes/__init__.py.
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
        """Read its output: pass on the events of nodes/runtime/process.py, log all else."""
        assert self.process.stdout is not None
        with self.process.stdout as lines, self.log.open('ab', 0) as log:
            for line in lines:
                # A process that is killed may leave half a line.
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
    """Context manager that starts processes on entry, and stops all of them before it exits.

    stages: processes in the order in which they are stopped. hurry: whether to kill them at once.
    pause_s: wait after each stage. grace_s: time to end in addition to the usual one.
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
        """Events of the processes; waits up to timeout [s] for the first one."""
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
            reader.join(1.0)  # a process that left the group may keep the output open

    def _groups(self) -> list[list[int]]:
        """The process groups of each stage, as far as they have been started."""
        return [[child.process.pid for child in stage if child in self.children]
                for stage in self._stages]


def stop_stages(
    stages: Sequence[Sequence[int]], pause_s: float, grace_s: float,
    hurry: Callable[[], bool] = lambda: False,
) -> None:
    """Send process groups, stage by stage, stronger and stronger signals until none is alive.

    hurry: whether to skip to SIGKILL. pause_s, grace_s: as in ProcessSupervisor.
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
    """The groups with a process left; zombies do not count, as they may never be reaped."""
    found = set()
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with suppress(OSError):  # gone meanwhile
            text = stat.read_text(encoding='utf-8', errors='replace')
            # The program name, in parentheses, may contain anything: proc_pid_stat(5).
            state, _, group, *others = text.rpartition(')')[2].split()
            # If only the main thread has ended, the process is shown as a zombie with threads.
            if state not in 'XZ' or (state == 'Z' and others[14] != '1'):
                found.add(int(group))
    return found.intersection(groups)


if __name__ == '__main__':  # the guardian
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # The last line says what to stop; it is complete once the supervisor has gone.
    if lines := sys.stdin.read().splitlines():
        stop_stages(*json.loads(lines[-1]))
