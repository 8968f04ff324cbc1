"""`simulate --cluster`: the same runs on a Dask cluster, whatever becomes of its workers."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from waiting import DEADLINE_S, wait_until

from backlash_ros.tools import batch
from backlash_ros.tools.bringup.environment import with_source
from backlash_ros.tools.simulate import main

HERE = '127.0.0.1'
RUNS = ['--duration', '1', '--set', 'output_noise_std=1e-3', '--seeds', '6']
# Nothing listens beyond this machine; the port for HTTP is open without a dashboard as well.
QUIET = ['--host', HERE, '--no-dashboard', '--dashboard-address', f'{HERE}:0']


class Cluster:
    """A scheduler and two workers as processes."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._stack = stack
        file = folder / 'scheduler.json'
        self.scheduler = self._start(
            'dask_scheduler', *QUIET, '--port', '0', '--scheduler-file', str(file)
        )
        wait_until(file.exists, 'scheduler')
        wait_until(lambda: file.read_text().endswith('}'), 'address of the scheduler')
        self.address: str = json.loads(file.read_text())['address']
        # Without a nanny, which would start a killed worker anew.
        self.workers = {
            name: self._start(
                'dask_worker', self.address, *QUIET, '--no-nanny',
                '--nthreads', '1', '--name', name, '--local-directory', str(folder),
            ) for name in ('first', 'second')
        }

    def _start(self, program: str, *arguments: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, '-m', f'distributed.cli.{program}', *arguments],
            env=with_source({**os.environ, 'OMP_NUM_THREADS': '1'}),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        self._stack.callback(process.wait, DEADLINE_S)
        self._stack.callback(process.kill)
        return process

    def addresses(self) -> set[str]:
        """Where its processes listen."""
        import psutil
        return {
            connection.laddr.ip for process in (self.scheduler, *self.workers.values())
            for connection in psutil.Process(process.pid).net_connections('inet')
            if connection.status == psutil.CONN_LISTEN
        }

    def is_whole(self) -> bool:
        """Whether every worker is there."""
        from distributed import Client
        with Client(self.address, set_as_default=False) as client:
            return len(client.scheduler_info()['workers']) == len(self.workers)

    def runs_of(self, name: str) -> list[str]:
        """What the worker has to do at present."""
        from distributed import Client
        with Client(self.address, set_as_default=False) as client:
            workers = client.scheduler_info()['workers']
            return [
                key for worker, keys in client.processing().items()
                if worker in workers and workers[worker]['name'] == name for key in keys
            ]


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip('distributed')
    with ExitStack() as stack:
        yield Cluster(tmp_path, stack)


def test_a_killed_worker_loses_no_run_and_no_bit_and_another_numpy_is_refused(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    wait_until(cluster.is_whole, 'the workers')  # simulate does so for 10 s only
    with monkeypatch.context() as other:
        other.setattr(batch, 'version', lambda name: '0.1')
        assert main([*RUNS, '--cluster', cluster.address]) == 2
    assert 'install the same versions' in capsys.readouterr().err
    remote, local = tmp_path / 'remote', tmp_path / 'local'
    simulation = subprocess.Popen(
        [sys.executable, '-m', 'backlash_ros.tools.simulate', *RUNS, '--out', str(remote),
         '--cluster', cluster.address],
        env=with_source(os.environ), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )
    try:
        wait_until(lambda: cluster.runs_of('first'), 'runs of the worker')
        assert cluster.addresses() == {HERE}
        os.kill(cluster.workers['first'].pid, signal.SIGKILL)
        assert main([*RUNS, '--out', str(local)]) == 0
        said, _ = simulation.communicate(timeout=DEADLINE_S)
    finally:
        simulation.kill()
        simulation.wait()
    assert simulation.returncode == 0, said
    assert (remote / 'seeds.csv').read_bytes() == (local / 'seeds.csv').read_bytes()
