"""Processes of a measurement: nodes and others in a domain, what they say, that they run."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from backlash_ros.tools.bringup.environment import child_environment, free_domain
from backlash_ros.tools.bringup.supervisor import Child, ProcessSupervisor

DEADLINE_S = 30.0  # for processes to start
NODES = 'backlash_ros.nodes'


@contextmanager
def processes(commands: Mapping[str, Sequence[str]]) -> Iterator[tuple[ProcessSupervisor, int]]:
    """The processes of one measurement in a domain of their own; all are gone afterwards."""
    with free_domain() as domain, processes_in(domain, commands) as supervisor:
        yield supervisor, domain


@contextmanager
def processes_in(domain: int, commands: Mapping[str, Sequence[str]]) -> Iterator[ProcessSupervisor]:
    """Processes in this domain, by name; all are gone afterwards."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = child_environment(folder, domain)
        stages = [
            [Child(who, tuple(command), folder / f'{who}.log', environment,
                         foreign='-m' not in command)]  # no node of the package
            for who, command in commands.items()
        ]
        with ProcessSupervisor(stages, lambda: False) as supervisor:
            yield supervisor


def node_command(name: str, values: Mapping[str, object]) -> list[str]:
    """How to start a node with parameters."""
    arguments: list[str] = ['--ros-args'] if values else []
    for key, value in values.items():
        text = value if isinstance(value, str) else json.dumps(value)
        arguments += ['-p', f'{key}:={text}']
    return [sys.executable, '-m', f'{NODES}.{name}', *arguments]


def wait_for_event(
    supervisor: ProcessSupervisor, wanted: Callable[[str, str], bool],
    patience_s: float = 10.0 * DEADLINE_S,
) -> float:
    """Time at which an event of this kind and process came [s]."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        for child, event in supervisor.events(0.1):
            if wanted(event['event'], child.name):
                return time.perf_counter()
        check_running(supervisor)
    raise RuntimeError('the nodes did not come to an end in time')


def check_running(supervisor: ProcessSupervisor) -> None:
    """Raise RuntimeError if a process has ended."""
    for child in supervisor.children:
        if child.has_ended:
            raise RuntimeError(f'{child.name} ended: {child.end_of_log()}')
