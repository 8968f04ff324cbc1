"""Nodes as processes that begin where the imports have been done: a start costs 0.05 s, not 1 s.

A process that has imported everything, and has no node yet, is forked. What differs from
`python -m backlash_ros.nodes.NAME` is the start of the interpreter and its end; the tests of
bringup and of the installation see both.
"""

from __future__ import annotations

import importlib
import io
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.context import ForkServerProcess
from pathlib import Path

PACKAGE = 'backlash_ros.nodes'
FORKING = multiprocessing.get_context('forkserver')
FORKING.set_forkserver_preload([
    f'{PACKAGE}.{name}' for name in ('controller', 'plant', 'reference', 'recorder')
])


class ForkedNode:
    """A node in a process of its own, with the methods of subprocess.Popen that tests use."""

    def __init__(
        self, executable: str, arguments: Sequence[str], stdout: Path, stderr: Path,
        environment: Mapping[str, str],
    ) -> None:
        # Daemons end with the tests.
        self._process: ForkServerProcess = FORKING.Process(
            target=_run_node, daemon=True,
            args=(executable, list(arguments), stdout, stderr, dict(environment)),
        )
        before = os.environ.get('BACKLASH_ROS_EVENTS')
        # The first start forks nothing yet, but does the imports, one of which reads this.
        os.environ['BACKLASH_ROS_EVENTS'] = '1'
        try:
            self._process.start()
        finally:
            if before is None:
                del os.environ['BACKLASH_ROS_EVENTS']
            else:
                os.environ['BACKLASH_ROS_EVENTS'] = before

    @property
    def pid(self) -> int:
        """Its process id."""
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Its exit code, the negative number of the signal that killed it, or None."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """The same."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, once it has ended; raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout or 0.0)
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to it alone, if it is there."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


def _run_node(
    executable: str, arguments: list[str], stdout: Path, stderr: Path, environment: dict[str, str],
) -> None:
    """Become what `python -m backlash_ros.nodes.EXECUTABLE ARGUMENTS` is."""
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
