"""Worker processes: what they compute, what their death costs; runs on a Dask cluster."""

import ctypes
import math
import operator
import os
import platform
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
from places import ROOT
from waiting import DEADLINE_S, wait_until
from worker_jobs import checksum, foreign_modules, last_for_ever

from backlash_ros.core.jobs import LOST, Channel, Failure, WorkerExecutor
from backlash_ros.core.priority import TURN_NS
from backlash_ros.tools.bringup.supervisor import with_source
from backlash_ros.tools.simulate import main

KILLED = 3  # times
SCHED_GETATTR = {'x86_64': 315, 'aarch64': 275}.get(platform.machine(), -1)  # system call
PARENT = f"""
import sys, time
sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / 'test')!r}]
from pathlib import Path
from backlash_ros.core.jobs import WorkerExecutor
from backlash_ros.core.priority import answer_first
from worker_jobs import last_for_ever
answer_first()
executor = WorkerExecutor()
channel = executor.open()
channel.submit(last_for_ever, Path(sys.argv[1]))
print(executor.worker.pid, flush=True)
while True:
    channel.poll()
    time.sleep(0.01)
"""


@pytest.fixture
def executor() -> Iterator[WorkerExecutor]:
    made = WorkerExecutor()
    yield made
    made.close()


def result_of(channel: Channel) -> object:
    assert channel.busy
    results: list[object] = []
    def has_come() -> bool:
        results.append(channel.poll())
        return not channel.busy
    wait_until(has_come, 'a result', lambda: time.sleep(1e-3))
    return results[-1]


def is_there(pid: int) -> bool:
    """Whether a process runs, which a zombie does not."""
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


def begin(channel: Channel, begun: Path) -> None:
    """Have the worker compute something that takes for ever, and wait until it does."""
    begun.unlink(missing_ok=True)
    channel.submit(last_for_ever, begun)
    wait_until(lambda: channel.poll() is None and begun.exists(), 'the job is under way')


def test_what_a_job_raises_or_cannot_return_comes_back_as_a_value(executor):
    channel = executor.open()
    for job, argument, kind in (
        (math.sqrt, -1.0, 'ValueError'), (open, '/nowhere', 'FileNotFoundError'),
        (memoryview, b'', 'TypeError'),
    ):
        channel.submit(job, argument)
        failure = result_of(channel)
        assert isinstance(failure, Failure)
        assert failure.kind == kind
    channel.submit(print, 'no result')
    assert result_of(channel) is None
    channel.submit(operator.neg, 4)
    assert result_of(channel) == -4


def test_a_worker_imports_neither_ros_nor_the_program_that_started_it(executor):
    channel = executor.open()
    channel.submit(foreign_modules)
    found = result_of(channel)
    assert {'numpy', 'backlash_ros', 'worker_jobs'} <= set(found)
    assert not {'rclpy', 'pytest', 'matplotlib', 'rosbags'} & set(found)


def test_a_worker_that_stands_still_holds_up_nobody(executor: WorkerExecutor) -> None:
    channel, other, values = executor.open(), executor.open(), np.arange(50_000.0)
    os.kill(executor.worker.pid, signal.SIGSTOP)
    # Ten times what a pipe takes: would any of these calls wait for the worker, it would for ever.
    channel.submit(checksum, values, 1.0)
    other.submit(operator.add, b'x' * 1_000_000, b'y')
    for _ in range(1000):
        assert channel.poll() is other.poll() is None
    os.kill(executor.worker.pid, signal.SIGCONT)
    assert result_of(channel) == checksum(values, 1.0)
    assert result_of(other) == b'x' * 1_000_000 + b'y'


def test_a_worker_that_is_killed_costs_nothing_but_the_job_under_way(executor, tmp_path):
    begun = tmp_path / 'begun'
    sleeper, channel, third = executor.open(), executor.open(), executor.open()
    rng = np.random.default_rng(2)
    for count in range(1, KILLED + 1):
        begin(sleeper, begun)
        values = rng.standard_normal(rng.integers(0, 400))
        channel.submit(checksum, values, 1.0)
        third.submit(operator.neg, count)
        os.kill(executor.worker.pid, signal.SIGKILL)
        failure = result_of(sleeper)
        assert isinstance(failure, Failure)
        assert failure.kind == LOST
        assert (result_of(third), result_of(channel)) == (-count, checksum(values, 1.0))
        assert executor.restarts == count
        assert executor.worker is not None


def parent_of_a_worker(begun: Path) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, '-c', PARENT, str(begun)], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGINT])
def test_a_worker_ends_with_its_parent_though_it_works(tmp_path: Path, number: int) -> None:
    begun = tmp_path / 'begun'
    with parent_of_a_worker(begun) as parent:
        try:
            worker = int(parent.stdout.readline())
            wait_until(begun.exists, 'the job is under way')
            assert is_there(worker)
        finally:
            parent.send_signal(number)
        wait_until(lambda: not is_there(worker), 'the worker has ended')
        assert parent.stderr.read().count('Traceback') == (number == signal.SIGINT)


def turn_of(pid: int) -> int:
    """Length of the turns of a process [ns], 0 if the kernel does not tell."""
    attributes = ctypes.create_string_buffer(48)
    ctypes.CDLL(None).syscall(SCHED_GETATTR, pid, attributes, len(attributes), 0)
    return int(struct.unpack('=IIQiIQQQ', attributes.raw)[5])


def test_a_loop_is_served_before_its_worker(tmp_path: Path) -> None:
    with parent_of_a_worker(tmp_path / 'begun') as parent:
        try:
            worker = psutil.Process(int(parent.stdout.readline()))
            loop = psutil.Process(parent.pid)
            assert (loop.nice(), worker.nice()) == (os.nice(0), os.nice(0) + 5)
            if not turn_of(os.getpid()):
                pytest.skip('turns are all alike: Linux is older than 6.12')
            assert {turn_of(thread.id) for thread in loop.threads()} == {TURN_NS}
            assert turn_of(worker.pid) > TURN_NS or os.cpu_count() == 1
        finally:
            parent.kill()


RUNS = ['--duration', '1', '--set', 'output_noise_std=1e-3', '--seeds', '6']


def test_a_killed_worker_loses_no_run_and_no_bit(tmp_path: Path) -> None:
    distributed = pytest.importorskip('distributed')
    remote, local = tmp_path / 'remote', tmp_path / 'local'
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host='127.0.0.1', dashboard_address=None,
        local_directory=str(tmp_path),
    ) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        simulation = subprocess.Popen(
            [sys.executable, '-m', 'backlash_ros.tools.simulate', *RUNS, '--out', str(remote),
             '--cluster', cluster.scheduler_address],
            env=with_source(os.environ), stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True)
        try:
            worker = cluster.workers[0]
            wait_until(
                lambda: client.processing()[worker.worker_address]
                or simulation.poll() is not None, 'runs of the worker')
            os.kill(worker.pid, signal.SIGKILL)
            assert main([*RUNS, '--out', str(local)]) == 0
            said, _ = simulation.communicate(timeout=4.0 * DEADLINE_S)
        finally:
            simulation.kill()
            simulation.wait()
    assert simulation.returncode == 0, said
    assert (remote / 'seeds.csv').read_bytes() == (local / 'seeds.csv').read_bytes()
