"""`simulate --cluster`: the same runs on a Dask cluster, whatever becomes of its workers."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import DEADLINE_S, wait_until

from backlash_ros.tools import batch
from backlash_ros.tools.bringup.supervisor import with_source
from backlash_ros.tools.simulate import main

RUNS = ['--duration', '1', '--set', 'output_noise_std=1e-3', '--seeds', '6']


def test_a_killed_worker_loses_no_run_and_no_bit_and_another_numpy_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    distributed = pytest.importorskip('distributed')
    remote, local = tmp_path / 'remote', tmp_path / 'local'
    # Nothing listens beyond this machine.
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host='127.0.0.1', dashboard_address=None,
        local_directory=str(tmp_path),
    ) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        with monkeypatch.context() as other:
            other.setattr(batch, 'version', lambda name: '0.1')
            assert main([*RUNS, '--cluster', cluster.scheduler_address]) == 2
        assert 'install the same versions' in capsys.readouterr().err
        simulation = subprocess.Popen(
            [sys.executable, '-m', 'backlash_ros.tools.simulate', *RUNS, '--out', str(remote),
             '--cluster', cluster.scheduler_address],
            env=with_source(os.environ), stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            worker = cluster.workers[0]
            wait_until(
                lambda: client.processing()[worker.worker_address]
                or simulation.poll() is not None, 'runs of the worker',
            )
            os.kill(worker.pid, signal.SIGKILL)
            assert main([*RUNS, '--out', str(local)]) == 0
            said, _ = simulation.communicate(timeout=4.0 * DEADLINE_S)
        finally:
            simulation.kill()
            simulation.wait()
    assert simulation.returncode == 0, said
    assert (remote / 'seeds.csv').read_bytes() == (local / 'seeds.csv').read_bytes()
