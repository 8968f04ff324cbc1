"""How bringup watches and ends processes, with small programs in the place of the nodes."""

import os
import signal
import sys
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from bringup_processes import DEADLINE_S, MARK, marked_processes, wait_until

from backlash_ros.tools.bringup import plan as planning
from backlash_ros.tools.bringup import supervisor as supervising
from backlash_ros.tools.bringup.plan import Axis
from backlash_ros.tools.bringup.supervisor import Child, ProcessSupervisor, child_environment
from backlash_ros.tools.bringup.watch import execute
from backlash_ros.tools.cli import StopRequests
from backlash_ros.tools.config import read_configuration

READY = (
    'import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]);'
    'print(\'{"event": "ready"}\', flush=True)'
)
WAIT = 'signal.sigwait([signal.SIGINT])'
DEAF = (
    'import os, signal, subprocess, sys, time;'
    'signal.signal(signal.SIGINT, signal.SIG_IGN); signal.signal(signal.SIGTERM, signal.SIG_IGN);'
    'subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]);'
)


def begun(file: Path) -> str:
    return f'open({str(file)!r}, "w").close();'


@dataclass
class Watched:
    """What became of a run of small programs."""

    failure: str
    complaint: str
    mark: str


@pytest.fixture
def watch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> Iterator[Callable[..., Watched]]:
    """Run bringup's loop over Python programs given by name; none of them is left at the end."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv(MARK, mark)
    def watch_programs(hurry: bool = False, **programs: str) -> Watched:
        parameters = read_configuration(None).parameters().replaced({'samples': 100})
        axis = Axis('', parameters, tmp_path)
        axis.logs.mkdir()
        stages = [
            [Child(name, (sys.executable, '-c', program), axis.logs / f'{name}.log', axis)]
            for name, program in programs.items()]
        environment = child_environment(axis.logs, 0)
        with ProcessSupervisor(stages, environment, lambda: hurry) as supervisor:
            failure = execute([axis], supervisor, StopRequests())
        return Watched(failure, capsys.readouterr().err, mark)
    yield watch_programs
    for pid in marked_processes(mark):
        os.kill(pid, signal.SIGKILL)


def test_a_process_that_is_never_ready_is_named_with_the_end_of_its_log(
    watch: Callable[..., Watched], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(planning, 'START_DEADLINE_S', 5.0)
    lines = 'import time; print("hello", *range(100, 130), sep="\\n", flush=True)'
    run = watch(slow=f'{lines}; time.sleep(600)', quick=f'{READY}; {WAIT}')
    assert run.failure.startswith('not ready within 5 s: slow, see ')
    assert '    129' in run.complaint
    assert '    119' not in run.complaint
    assert (tmp_path / 'logs' / 'slow.log').read_text().startswith('hello\n100\n')


def test_what_ends_by_itself_ends_all_the_deaf_and_their_children_included(watch, tmp_path):
    file = tmp_path / 'begun'
    mortal = (
        'import os, sys, time\n'
        f'while not os.path.exists({str(file)!r}): time.sleep(0.01)\n'
        'sys.exit("no memory left")')
    run = watch(hurry=True, deaf=f'{DEAF}{begun(file)}time.sleep(600)', mortal=mortal)
    assert run.failure.startswith('mortal died (exit code 1)')
    assert 'no memory left' in run.complaint
    wait_until(lambda: not marked_processes(run.mark), 'all have gone')


def test_stages_end_one_after_the_other_each_with_the_time_that_it_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(supervising, 'ESCALATION', (
        (signal.SIGINT, 0.2), (signal.SIGTERM, 0.2), (signal.SIGKILL, DEADLINE_S)))
    files, gone = [tmp_path / f'begun{i}' for i in range(3)], tmp_path / 'gone'
    patient = f'{READY}; {begun(files[0])} {WAIT}; import time; time.sleep(0.6); {begun(gone)}'
    after = f'{READY}; {begun(files[1])} {WAIT}; import os; print(os.path.exists({str(gone)!r}))'
    deaf = f'{DEAF}{begun(files[2])}time.sleep(600)'
    stages = [
        [Child(str(i), (sys.executable, '-c', program), tmp_path / f'{i}.log', foreign=True)]
        for i, program in enumerate((patient, after, deaf))]
    environment = child_environment(tmp_path, 0)
    with ProcessSupervisor(stages, environment, pause_s=0.3, grace_s=1.0) as supervisor:
        wait_until(lambda: all(file.exists() for file in files), 'all programs have begun')
        supervisor.stop()
        codes = [child.process.returncode for child in supervisor.children]
    assert codes == [0, 0, -signal.SIGKILL]
    assert (tmp_path / '1.log').read_text().splitlines()[-1] == 'True'
