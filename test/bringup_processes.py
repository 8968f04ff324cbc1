"""Helpers for tests of bringup as a process: start it, and find all that it has started."""

import os
import signal
import subprocess
import sys
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
from rosbags.highlevel import AnyReader
from waiting import DEADLINE_S, wait_until

from backlash_ros.tools.bringup import __main__ as bringup

MARK = 'BACKLASH_TEST_RUN'  # a variable of the environment
UNDRAWN = Path(__file__).with_name('undrawn.py')


def marked_processes(mark: str) -> dict[int, str]:
    found = {}
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # gone meanwhile, or of another user
            if process.environ().get(MARK) == mark:
                found[process.pid] = ' '.join(process.cmdline())
    return found


@dataclass
class Session:
    """A bringup that was started; all its processes carry the mark in their environment."""

    process: subprocess.Popen[bytes]
    mark: str
    out: Path
    stdout_file: Path
    stderr_file: Path

    @property
    def stdout(self) -> str:
        return self.stdout_file.read_text()

    @property
    def stderr(self) -> str:
        return self.stderr_file.read_text()

    def wait(self) -> int:
        return self.process.wait(DEADLINE_S)

    def wait_for_samples(self, axis: str = '') -> None:
        wait_until(
            lambda: self.process.poll() is not None or any(
                ' lost ' in line and line.startswith(axis) for line in self.stderr.splitlines()
            ), 'progress')
        assert self.process.poll() is None, self.stderr

    def survivors(self) -> dict[int, str]:
        return marked_processes(self.mark)

    def node(self, name: str, namespace: str = '') -> int:
        module = f'backlash_ros.nodes.{name} '
        (pid,) = (
            pid for pid, command in self.survivors().items()
            if module in command and namespace in command.split(' -r ')[-1])
        return pid


@contextmanager
def bringup_sessions(folder: Path) -> Iterator[Callable[..., Session]]:
    """Start bringup with arguments; whatever is left of it at the end is killed.

    Reports have no pictures, which take longer than most runs.
    """
    sessions: list[Session] = []
    def start_session(*arguments: str, variables: Mapping[str, str] | None = None) -> Session:
        own = folder / str(len(sessions))
        own.mkdir()
        mark = uuid.uuid4().hex
        environment = {**os.environ, MARK: mark}
        for variable in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
            environment.pop(variable, None)
        environment.update(variables or {})
        stdout, stderr = own / 'stdout.txt', own / 'stderr.txt'
        whole = '--no-record' in arguments
        program = ['-m', 'backlash_ros.tools.bringup'] if whole else [
            str(UNDRAWN), bringup.__name__]
        with stdout.open('wb') as out, stderr.open('wb') as err:
            process = subprocess.Popen(
                [sys.executable, *program, '--out', str(own / 'results'), *arguments],
                stdout=out, stderr=err, env=environment,
                cwd=Path(bringup.__file__).resolve().parents[2])
        session = Session(process, mark, own / 'results', stdout, stderr)
        sessions.append(session)
        return session
    try:
        yield start_session
    finally:
        for session in sessions:
            for pid in session.survivors():
                os.kill(pid, signal.SIGKILL)
            session.wait()


def bag_counts(bag: Path) -> dict[str, int]:
    with AnyReader([bag]) as reader:
        return Counter(connection.topic.lstrip('/') for connection, *_ in reader.messages())
