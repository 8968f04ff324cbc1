"""Helpers for tests with real nodes: processes, and a node of the test among them."""

import importlib
import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any
from unittest.mock import patch

# Before rclpy reads it.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from waiting import DEADLINE_S, wait_until

from backlash_ros.middleware import prefer_loopback
from backlash_ros.tools.bringup.supervisor import child_environment, free_domain

prefer_loopback(os.environ)  # the nodes of the tests themselves

# Nodes begin where the imports have been done: a start costs 0.05 s, not 1 s. A process that has
# imported everything, and has no node yet, is forked. What differs from python -m is the start of
# the interpreter and its end; the tests of bringup and of the installation see both.
PACKAGE = 'backlash_ros.nodes'
FORKING = multiprocessing.get_context('forkserver')
FORKING.set_forkserver_preload([
    f'{PACKAGE}.{name}' for name in ('controller', 'plant', 'reference', 'recorder')
])

AGAIN_S = 5.0  # without an answer, after which a service is asked again


class ForkedNode:
    """A node in a process of its own, with the methods of subprocess.Popen that tests use."""

    def __init__(
        self, executable: str, arguments: Sequence[str], stdout: Path, stderr: Path,
        environment: Mapping[str, str],
    ) -> None:
        # Daemons end with the tests.
        self._process: ForkServerProcess = FORKING.Process(
            target=_run_node, daemon=True,
            args=(executable, list(arguments), stdout, stderr, dict(environment)))
        # The first start forks nothing yet, but does the imports, one of which reads this.
        with patch.dict(os.environ, BACKLASH_ROS_EVENTS='1'):
            self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, once it has ended; raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout or 0.0)
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _run_node(
    executable: str, arguments: list[str], stdout: Path, stderr: Path, environment: dict[str, str],
) -> None:
    for path, number in ((stdout, 1), (stderr, 2)):
        with path.open('ab') as file:
            os.dup2(file.fileno(), number)
    for stream in (sys.stdout, sys.stderr):
        assert isinstance(stream, io.TextIOWrapper)
        stream.reconfigure(line_buffering=True)
    os.environ.clear()
    os.environ.update(environment)
    module = importlib.import_module(f'{PACKAGE}.{executable}')
    sys.argv = [str(module.__file__), *arguments]
    sys.exit(module.main())


class NodeProcess:
    """A node started as a process; its events can be waited for, its stderr read."""

    def __init__(
        self, executable: str, arguments: list[str], folder: Path, environment: dict[str, str],
        forked: bool,
    ) -> None:
        self.executable = executable
        number = len(list(folder.glob('*.stderr')))
        self._stdout, self._stderr = (
            folder / f'{number}-{executable}.{kind}' for kind in ('stdout', 'stderr'))
        with self._stdout.open('wb') as out, self._stderr.open('wb') as err:
            self.process = ForkedNode(
                executable, arguments, self._stdout, self._stderr, environment
            ) if forked else subprocess.Popen(
                [sys.executable, '-m', f'backlash_ros.nodes.{executable}', *arguments],
                stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment)

    @property
    def stderr(self) -> str:
        return self._stderr.read_text()

    @property
    def stdout(self) -> str:
        return self._stdout.read_text()

    def events(self, kind: str) -> list[dict[str, Any]]:
        # The last piece may be a line that is still being written.
        lines = self._stdout.read_text().split('\n')[:-1]
        return [event for event in map(json.loads, lines) if event['event'] == kind]

    def wait_for(self, kind: str) -> dict[str, Any]:
        wait_until(
            lambda: self.events(kind) or self.process.poll() is not None,
            f'{kind} of {self.executable}')
        events = self.events(kind)
        assert events, f'{self.executable} ended without {kind}:\n{self.stderr}'
        return events[0]

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        self.send(number)
        return self.wait()

    def wait(self) -> int:
        return self.process.wait(DEADLINE_S)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class Probe:
    """A node of the test: it publishes, and keeps what it hears."""

    def __init__(self, domain: int, name: str = 'probe') -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = Node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._asked_at = 0.0

    def collect(self, topic: str, message_type: type[Any]) -> list[Any]:
        heard: list[Any] = []
        self.node.create_subscription(message_type, topic, heard.append, 1000)
        return heard

    def publisher(self, topic: str, message_type: type[Any]) -> Publisher:
        return self.node.create_publisher(message_type, topic, 1000)

    def wait_until(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, lambda: self._executor.spin_once(timeout_sec=0.02))

    def ask(self, call: Callable[[], Future], what: str) -> Any:
        """The result of an asynchronous call of a service.

        It is made again where no answer comes: a server that has not discovered this client when
        it answers is not heard.
        """
        asked: list[Future] = []
        def answered() -> bool:
            if not asked or time.monotonic() > self._asked_at + AGAIN_S:
                asked.append(call())
                self._asked_at = time.monotonic()
            return any(future.done() for future in asked)
        self.wait_until(answered, what)
        return next(future for future in asked if future.done()).result()

    def spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=seconds)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class RosWorld:
    """A domain of its own with the nodes of one test in it.

    forked: whether nodes begin where the imports have been done. Where the start of the interpreter
    is of interest, or what it and the imports read from the environment, they must not.
    """

    def __init__(self, folder: Path, domain: int, stack: ExitStack) -> None:
        self.folder = folder
        self.domain, self._stack = domain, stack
        self.environment = child_environment(folder, domain)
        self.forked = True

    def start(
        self, executable: str, parameters: Mapping[str, object] | None = None, *arguments: str,
    ) -> NodeProcess:
        ros_arguments = ['--ros-args'] if parameters else []
        for name, value in (parameters or {}).items():
            text = value if isinstance(value, str) else json.dumps(value)
            ros_arguments += ['-p', f'{name}:={text}']
        process = NodeProcess(executable, [*ros_arguments, *arguments], self.folder,
                              self.environment, self.forked)
        self._stack.callback(process.kill)
        return process

    def probe(self) -> Probe:
        probe = Probe(self.domain)
        self._stack.callback(probe.close)
        return probe


@contextmanager
def ros_world(folder: Path) -> Iterator[RosWorld]:
    with free_domain() as domain, ExitStack() as stack:
        yield RosWorld(folder, domain, stack)
