"""Processes of a measurement in a domain of their own, and a node among them."""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

# Before rclpy reads it.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from backlash_ros.middleware import prefer_loopback
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.tools.bringup.supervisor import (
    Child,
    ProcessSupervisor,
    child_environment,
    free_domain,
)

DEADLINE_S = 30.0  # for processes to start


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
        # What is no node of the package is foreign.
        stages = [[Child(who, command, folder / f'{who}.log', foreign='-m' not in command)]
                  for who, command in commands.items()]
        with ProcessSupervisor(stages, environment) as supervisor:
            yield supervisor


def node_command(name: str, values: Mapping[str, object]) -> list[str]:
    """How to start a node with parameters."""
    arguments: list[str] = ['--ros-args'] if values else []
    for key, value in values.items():
        text = value if isinstance(value, str) else json.dumps(value)
        arguments += ['-p', f'{key}:={text}']
    return [sys.executable, '-m', f'backlash_ros.nodes.{name}', *arguments]


def wait_for_event(
    supervisor: ProcessSupervisor, kind: str, *names: str, patience_s: float = 10.0 * DEADLINE_S,
) -> float:
    """Time at which an event of this kind had come from each of these processes [s]."""
    deadline, missing = time.monotonic() + patience_s, set(names)
    while time.monotonic() < deadline:
        for child, event in supervisor.events(0.1):
            if event['event'] == kind:
                missing.discard(child.name)
            if not missing:
                return time.perf_counter()
        check_running(supervisor)
    raise RuntimeError(f'not in time: {kind} of {", ".join(missing)}')


def check_running(supervisor: ProcessSupervisor) -> None:
    """Raise RuntimeError if a process has ended."""
    for child in supervisor.children:
        if child.process.poll() is not None:
            raise RuntimeError(f'{child.name} ended: {child.end_of_log()}')


class MeasuringNode:
    """Node and executor of whoever takes the place of the driver, or listens."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        prefer_loopback(os.environ)
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = Node('driver', context=self._context)
        # The executor of rclpy would begin to wait after the answer has come: the times would
        # be those of the driver.
        self.executor = PromptExecutor(self.node)

    def spin(self, seconds: float) -> None:
        self.executor.spin_once(timeout_sec=max(seconds, 0.0))

    def wait_for(self, condition: Callable[[], object], longest_s: float, what: str = '') -> None:
        """Listen until the condition holds; raises RuntimeError if it never does, for a `what`."""
        deadline = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > deadline:
                if what:
                    raise RuntimeError(f'{what}: not there within {longest_s:g} s')
                return
            self.spin(0.02)

    def wait_till(self, time_s: float) -> None:
        """Listen until then, by time.perf_counter."""
        while (left := time_s - time.perf_counter()) > 0.0:
            self.executor.serve_urgent(int(1e9 * left))

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
