"""bringup with real processes: whole runs, interruptions, deaths, bad input."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from bringup_processes import Session, bag_counts, marked_processes, wait_until

from backlash_ros import topics
from backlash_ros.tools.bringup import axis_progress, domains, environment, supervision
from backlash_ros.tools.bringup import command as bringup
from backlash_ros.tools.bringup.environment import child_environment
from backlash_ros.tools.bringup.processes import ProcessPlan, ProcessSupervisor
from backlash_ros.tools.bringup.progress import ProgressDisplay, describe
from backlash_ros.tools.bringup.run_plan import AxisPlan, RunPlan
from backlash_ros.tools.cli.stop_requests import StopRequests
from backlash_ros.tools.config.configuration import effective_parameters

NODES = ('controller', 'plant', 'recorder', 'reference')


def test_lockstep_run_ends_with_all_files_and_no_process(start: Callable[..., Session]) -> None:
    session = start('--lockstep', '--duration', '1', '--seed', '5', drawn=True)
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}

    summary = json.loads((session.out / 'summary.json').read_text())
    assert (summary['samples'], summary['lost_samples']) == (100, 0)
    assert len((session.out / 'samples.csv').read_text().splitlines()) == 101
    assert (session.out / 'report.html').is_file()
    for node in NODES:
        assert (session.out / 'logs' / f'{node}.log').is_file()
    counts = bag_counts(session.out / 'bag')
    for topic in (topics.PLANT_OUTPUT, topics.CONTROL, topics.SIGNALS, topics.ESTIMATES):
        assert counts[topic] == 100
    effective = yaml.safe_load((session.out / 'parameters.yaml').read_text())
    parameters = effective['/**']['ros__parameters']
    assert (parameters['seed'], parameters['lockstep'], parameters['samples']) == (5, True, 100)
    assert 'c_r' in session.stdout
    assert str(session.out / 'report.html') in session.stdout


def test_no_record_leaves_no_bag_and_still_shows_progress(start: Callable[..., Session]) -> None:
    session = start('--lockstep', '--duration', '1', '--no-record')
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert '/100  m ' in session.stderr
    assert 'no bag' in session.stdout
    assert sorted(path.name for path in session.out.iterdir()) == ['logs', 'parameters.yaml']


def test_recorder_that_was_held_up_gets_all_that_it_has_missed(
    start: Callable[..., Session],
) -> None:
    session = start('--lockstep', '--duration', '8')
    session.wait_for_samples()
    recorder = session.node('recorder')
    os.kill(recorder, signal.SIGSTOP)
    # Far more messages than the middleware keeps on the way to a process.
    time.sleep(0.8)
    os.kill(recorder, signal.SIGCONT)
    assert session.wait() == 0, session.stderr
    summary = json.loads((session.out / 'summary.json').read_text())
    assert (summary['samples'], summary['lost_samples']) == (800, 0)
    counts = bag_counts(session.out / 'bag')
    for topic in (
        topics.PLANT_OUTPUT, topics.APPLIED_CONTROL, topics.TRUTH, topics.SIGNALS, topics.ESTIMATES,
    ):
        assert counts[topic] == 800


def test_ctrl_c_leaves_a_readable_bag_and_a_report_and_no_process(
    start: Callable[..., Session],
) -> None:
    session = start('--duration', '100')
    session.wait_for_samples()
    session.process.send_signal(signal.SIGINT)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'interrupted by SIGINT' in session.stderr
    assert 'Traceback' not in session.stderr
    assert bag_counts(session.out / 'bag')[topics.PLANT_OUTPUT] > 0
    assert json.loads((session.out / 'summary.json').read_text())['samples'] > 0
    assert (session.out / 'report.html').is_file()


def test_sigterm_while_the_nodes_start_leaves_no_process(start: Callable[..., Session]) -> None:
    session = start('--duration', '100', '--no-record')
    wait_until(lambda: len(session.survivors()) > 3, 'nodes exist')
    session.process.send_signal(signal.SIGTERM)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert session.stderr == 'bringup: interrupted by SIGTERM, stopping\n'


def test_killed_controller_is_named_with_its_log_and_all_others_end(
    start: Callable[..., Session],
) -> None:
    session = start('--duration', '100', '--no-record')
    session.wait_for_samples()
    os.kill(session.node('controller'), signal.SIGKILL)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'controller died (killed by SIGKILL)' in session.stderr
    assert str(session.out / 'logs' / 'controller.log') in session.stderr


def test_no_process_survives_a_killed_bringup(start: Callable[..., Session]) -> None:
    session = start('--duration', '100')
    session.wait_for_samples()
    session.process.kill()
    session.wait()
    wait_until(lambda: not session.survivors(), 'the guardian has stopped all nodes')
    assert bag_counts(session.out / 'bag')[topics.PLANT_OUTPUT] > 0


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--set', 'estimator.initial.cr=1'], ['estimator.initial.cr', 'estimator.initial.c_r?']),
        (['--set', 'backlash.m=-1'], ['backlash.m=-1.0', 'must be > 0']),
        (['--set', 'estimator.bounds.m=[2, 1]'], ['estimator.bounds.m', 'low < high']),
        (['--set', 'plant.denominator=[0, 0]'], ['plant.denominator']),
        (['--set', 'control.min=3', '--set', 'control.max=2'], ['control.min', 'control.max']),
        (['--set', 'waveform=file'], ['file', 'CSV']),
        (['--set', 'bag=here'], ['bag', 'here', '--out']),
        (['--duration', '0.015'], ['duration', '0.015', 'sample_period']),
        (['--duration', '-1'], ['duration', '-1']),
        (['--duration', 'long'], ['--duration', 'long']),
        (['--driver', 'x', '--lockstep'], ["driver='x'", 'excludes lockstep', 'does not wait']),
        (['--driver', 'x --axis {axis}'], ['driver', 'names an axis', 'axes']),
        (['--driver', 'x'], [
            'control.min=-inf', 'set control.min, control.max, control.rate_max',
            'give --unlimited',
        ]),
        (['--driver', 'none', '--set', 'control.min=-5', '--set', 'control.max=5'], [
            'control.rate_max=inf', 'set control.rate_max, or',
        ]),
        (['--unlimited'], ['give --driver as well']),
        (['--driver', "x 'y"], ['driver', 'is not a command', 'quotation']),
        (['--axis', 'x'], ["no axis 'x'", 'axes', '/bringup']),
        (['--set', 'x/seed=3'], ['x/seed', "no axis 'x'"]),
        (['--set', 'axes=[a, b]', '--set', 'b/backlash.c_l=4'], ['b: backlash.c_l=4.0', '<']),
        (['--set', 'axes=[a, b]', '--set', 'estimates.file=e'], ["'e'", 'of a and of b']),
        (['--set', 'axes=[a, b, c, d, e, f, g, h]'], ['8 axes', 'at most 7']),
        (['--config', 'nowhere.yaml'], ['nowhere.yaml']),
        (['--out', '/proc/nowhere'], ['/proc/nowhere']),
        (['--speed', '3'], ['--speed']),
    ],
)
def test_bad_input_is_refused_in_one_line_before_anything_is_made(
    arguments: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert bringup.main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ''
    assert said.err.startswith('bringup: ')
    assert said.err.count('\n') == 1
    for word in words:
        assert word in said.err
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_is_heard_before_the_libraries_are_loaded() -> None:
    code = (
        'import sys, backlash_ros.tools.bringup.command as b; b.parse_options([]);'
        'sys.exit(bool({"numpy", "scipy", "rosbags"} & set(sys.modules)))'
    )
    root = Path(bringup.__file__).resolve().parents[3]
    assert subprocess.run([sys.executable, '-c', code], cwd=root).returncode == 0


def test_processes_find_this_package_behind_what_the_user_has_set() -> None:
    user, source = environment.with_source({'PYTHONPATH': '/of/the/user'})['PYTHONPATH'].split(':')
    assert user == '/of/the/user'
    assert (Path(source) / 'backlash_ros' / '__init__.py').is_file()


def test_folder_that_holds_a_bag_is_not_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / 'bag').mkdir()
    assert bringup.main(['--out', str(tmp_path)]) == 2
    assert 'holds a bag already' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


# What follows has small programs in the place of the nodes: what is tested is the watching.
READY = (
    'import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]);'
    'print(\'{"event": "ready"}\', flush=True)'
)
WAIT = 'signal.sigwait([signal.SIGINT])'
DONE = 'print(\'{"event": "done", "published": {"samples": 100}}\', flush=True)'


def progress(sample: int) -> str:
    return f'print(\'{{"event": "progress", "sample": {sample}}}\', flush=True)'


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
    monkeypatch.setenv('BACKLASH_TEST_RUN', mark)

    def watch_programs(hurry: bool = False, **programs: str) -> Watched:
        parameters = effective_parameters(None).replaced({
            'samples': 100, 'driver': 'some command' if 'driver' in programs else '',
        })
        axis = AxisPlan('', parameters, tmp_path, record=False)
        axis.logs.mkdir()
        environment = child_environment(axis.logs, None)
        stages = [
            [ProcessPlan(
                name, (sys.executable, '-c', program), axis.logs / f'{name}.log', environment,
                foreign=name == 'driver',
            )] for name, program in programs.items()
        ]
        with ProcessSupervisor(stages, lambda: hurry) as supervisor:
            displays = {'': ProgressDisplay(100, 0.01, sys.stderr)}
            plan = RunPlan((axis,), tmp_path)
            run = supervision.Run(plan, supervisor, StopRequests(), displays)
            run.execute()
        return Watched(run.failure, capsys.readouterr().err, mark)

    yield watch_programs
    for pid in marked_processes(mark):
        os.kill(pid, signal.SIGKILL)


def test_process_that_is_never_ready_is_named_with_the_end_of_its_log(
    watch: Callable[..., Watched], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervision, 'READY_DEADLINE_S', 1.0)
    lines = 'import sys; print(*range(100, 130), sep="\\n", file=sys.stderr, flush=True)'
    run = watch(slow=f'{lines}; import time; time.sleep(600)', quick=f'{READY}; {WAIT}')
    assert run.failure.startswith('not ready within 1 s: slow\n')
    assert '    129' in run.complaint
    assert '    119' not in run.complaint


def test_standstill_is_an_error_that_names_the_last_sample(
    watch: Callable[..., Watched], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(axis_progress, 'STALL_DEADLINE_S', 0.5)
    run = watch(recorder=f'{READY}; {progress(41)}; {WAIT}')
    assert 'no new sample for' in run.failure
    assert 'after sample 41' in run.failure


def test_samples_of_which_nothing_was_heard_are_told(watch: Callable[..., Watched]) -> None:
    # Diagnostics go on.
    again = (
        'import itertools, json\n'
        'for n in itertools.count():\n'
        '    if signal.sigtimedwait([signal.SIGINT], 0.01): break\n'
        '    progress = dict(event="progress", sample=41, received=dict(diagnostics=n))\n'
        '    print(json.dumps(progress), flush=True)'
    )
    run = watch(plant=f'{READY}; {DONE}; {WAIT}', recorder=f'{READY}\n{again}')
    assert not run.failure
    assert 'the plant has said more than the recorder heard: 58 samples' in run.complaint


def test_process_that_ends_by_itself_is_named_with_its_exit_code(
    watch: Callable[..., Watched],
) -> None:
    run = watch(plant='import sys; sys.exit("no memory left")', recorder=f'{READY}; {WAIT}')
    assert run.failure.startswith('plant died (exit code 1)')
    assert 'no memory left' in run.complaint


def test_unclean_end_after_a_whole_run_is_an_error(watch: Callable[..., Watched]) -> None:
    run = watch(plant=f'{READY}; {DONE}; {progress(99)}; {WAIT}; raise SystemExit(7)')
    assert run.failure.startswith('plant did not stop cleanly (exit code 7)')


def test_grandchildren_and_the_deaf_are_stopped_too(
    watch: Callable[..., Watched], tmp_path: Path,
) -> None:
    begun = tmp_path / 'begun'
    deaf = (
        'import signal, subprocess, sys, time;'
        'signal.signal(signal.SIGINT, signal.SIG_IGN);'
        'signal.signal(signal.SIGTERM, signal.SIG_IGN);'
        'subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]);'
        f'open({str(begun)!r}, "w").close(); time.sleep(600)'
    )
    mortal = (
        'import os, time\n'
        f'while not os.path.exists({str(begun)!r}): time.sleep(0.01)'
    )
    run = watch(hurry=True, deaf=deaf, mortal=mortal)
    assert run.failure.startswith('mortal died (exit code 0)')
    wait_until(lambda: not marked_processes(run.mark), 'all have gone')


def test_lines_that_are_no_events_stand_in_the_log(
    watch: Callable[..., Watched], tmp_path: Path,
) -> None:
    watch(plant='print("hello"); print(3); print("{}"); raise SystemExit(1)')
    assert (tmp_path / 'logs' / 'plant.log').read_text().splitlines() == ['hello', '3', '{}']


def test_two_runs_get_two_domains_and_none_that_somebody_uses() -> None:
    with domains.free_domain() as first:
        with domains.free_domain() as second:
            assert first != second
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
            port = domains.DOMAIN_0_PORT + domains.PORTS_PER_DOMAIN * second + 12
            participant.bind(('127.0.0.1', port))
            with domains.free_domain() as third:
                assert third not in (first, second)


def test_what_the_user_has_set_reaches_the_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    environment = child_environment(tmp_path, None)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'
    assert environment['ROS_DOMAIN_ID'] == '7'
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE')
    environment = child_environment(tmp_path, 9)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert environment['ROS_DOMAIN_ID'] == '9'


def test_errors_are_in_percent_of_the_truth_where_it_is_known() -> None:
    event = {'m': 1.43, 'true_m': 1.3, 'c_r': 2.7, 'true_c_r': None, 'c_l': -3.03,
             'true_c_l': -3.0, 'lost': 2}
    assert describe(event) == 'm 1.43 (+10.0 %)  c_r 2.7  c_l -3.03 (-1.0 %)  lost 2'
