"""Child processes of the orchestrator: start them, listen to them, leave none of them behind.

Every child leads a process group of its own, so that a Ctrl-C of the terminal reaches the
orchestrator alone, which then stops the children in order, grandchildren included. A small
guardian process (process_groups.py) holds the other end of a pipe: when the orchestrator dies of
whatever cause, the pipe closes and the guardian stops what is left.
Nothing here starts a thread: forking stays safe and a signal finds one loop to wake.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO

from backlash_ros.tools.bringup.environment import with_source
from backlash_ros.tools.bringup.process_groups import group_exists, stop_groups


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
        quoted = ''.join(f'\n    {line}' for line in lines[-10:])
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
                (sys.executable, '-m', 'backlash_ros.tools.bringup.process_groups'), bufsize=0,
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
