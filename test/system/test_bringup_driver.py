"""bringup with a driver in the place of the simulated plant: whole runs, and drivers that fail."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from bringup_processes import DEADLINE_S, Session, wait_until
from ros_processes import ros_world

from backlash_ros.tools.bringup import axis_progress, process_groups, supervision
from backlash_ros.tools.bringup.environment import child_environment, foreign_environment
from backlash_ros.tools.bringup.processes import ProcessPlan, ProcessSupervisor
from backlash_ros.tools.bringup.progress import ProgressDisplay
from backlash_ros.tools.bringup.run_plan import AxisPlan, RunPlan, plan_processes
from backlash_ros.tools.cli.stop_requests import StopRequests
from backlash_ros.tools.config.configuration import effective_parameters

PLANT = f'{shlex.quote(sys.executable)} -m backlash_ros.nodes.plant'
# Begins when controller, reference and recorder listen, so that nothing of it goes unrecorded.
PATIENT_PLANT = f'{PLANT} --ros-args -p wait_for_subscribers:=3'

# A driver that is none of this package: y follows v like a first-order lag, at 100 Hz.
DRIVER = """
import signal, sys, rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGINT, signal.{sigint})
node = rclpy.create_node('driver')
output = node.create_publisher(Float64, 'plant_output', 10)
state = {{'v': 0.0, 'y': 0.0}}
def die(number, frame):
    sys.exit('the fuse has blown')
signal.signal(signal.SIGUSR1, die)
node.create_subscription(Float64, 'control', lambda m: state.update(v=m.data), 1)
def tick():
    state['y'] += 0.1 * (state['v'] - state['y'])
    output.publish(Float64(data=state['y']))
node.create_timer(0.01, tick)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    print('last command', state['v'], flush=True)
"""


def driver_command(folder: Path, sigint: str = 'default_int_handler') -> str:
    """Command of a driver that dies of SIGUSR1, and treats SIGINT like that."""
    script = folder / 'driver.py'
    script.write_text(DRIVER.format(sigint=sigint))
    return shlex.join([sys.executable, str(script)])


def drivers(session: Session) -> list[int]:
    """Process ids of the drivers of a session."""
    return [
        pid for pid, command in session.survivors().items()
        if 'driver.py' in command and '--driver' not in command
    ]


def test_driver_takes_the_place_of_the_plant_until_enough_samples_are_recorded(
    start: Callable[..., Session],
) -> None:
    session = start(
        '--unlimited', '--driver', PATIENT_PLANT, '--duration', '1', '--seed', '3',
        '--set', 'backlash.m=2',
    )
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert sorted(path.name for path in (session.out / 'logs').glob('*.log')) == [
        'controller.log', 'driver.log', 'recorder.log', 'reference.log',
    ]
    # What it prints is no business of bringup, be it an event or not.
    assert '"event"' not in (session.out / 'logs' / 'driver.log').read_text()
    assert 'samples' in (session.out / 'logs' / 'driver.log').read_text()
    summary = json.loads((session.out / 'summary.json').read_text())
    assert summary['samples'] + summary['lost_samples'] >= 100
    assert summary['truth']['m'] == 1.3
    assert session.stderr.count('no use for what describes the simulated plant') == 1
    assert 'plant: backlash.*, seed\n' in session.stderr


def test_driver_that_dies_is_named_with_its_last_words_and_the_run_is_reported(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    session = start('--unlimited', '--driver', driver_command(tmp_path), '--duration', '100')
    session.wait_for_samples()
    (driver,) = drivers(session)
    os.kill(driver, signal.SIGUSR1)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'driver died (exit code 1)' in session.stderr
    assert f'{session.out}/logs/driver.log:\n    the fuse has blown' in session.stderr
    assert session.stderr.count('died') == 1
    assert json.loads((session.out / 'summary.json').read_text())['samples'] > 0
    assert (session.out / 'report.html').is_file()


def test_driver_that_does_not_exist_is_named_and_nothing_stays(
    start: Callable[..., Session],
) -> None:
    session = start('--unlimited', '--driver', '/no/such/driver --fast')
    assert session.wait() == 1
    assert session.survivors() == {}
    assert session.stderr == (
        'bringup: driver does not start: /no/such/driver: No such file or directory\n'
    )


def test_last_command_of_the_controller_reaches_the_driver(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    session = start(
        '--unlimited', '--driver', driver_command(tmp_path), '--duration', 'inf', '--no-record',
        '--set', 'on_stop=zero', '--set', 'bias=20',
    )
    session.wait_for_samples()
    session.process.send_signal(signal.SIGINT)
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert (session.out / 'logs' / 'driver.log').read_text() == 'last command 0.0\n'


def test_second_ctrl_c_ends_a_driver_that_ignores_the_first_one(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    session = start(
        '--unlimited', '--driver', driver_command(tmp_path, sigint='SIG_IGN'), '--duration', 'inf',
        '--no-record',
    )
    session.wait_for_samples()
    session.process.send_signal(signal.SIGINT)
    wait_until(
        lambda: not any('nodes.controller' in command for command in session.survivors().values()),
        'the controller has gone first',
    )
    assert drivers(session)
    session.process.send_signal(signal.SIGINT)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert 'driver did not stop cleanly (killed by SIGKILL)' in session.stderr


def test_sigterm_while_the_driver_starts_leaves_no_process(start: Callable[..., Session]) -> None:
    session = start('--unlimited', '--driver', f'sh -c "{PLANT}; true"', '--no-record')
    wait_until(lambda: len(session.survivors()) > 4, 'driver and nodes exist')
    session.process.send_signal(signal.SIGTERM)
    assert session.wait() == 1
    assert session.survivors() == {}
    assert session.stderr.startswith('bringup: interrupted by SIGTERM, stopping\n')
    assert 'Traceback' not in session.stderr


def test_no_grandchild_of_a_driver_survives_a_killed_bringup(start: Callable[..., Session]) -> None:
    session = start(
        '--unlimited', '--driver', f'sh -c "{PLANT}; true"', '--duration', '100', '--no-record',
    )
    session.wait_for_samples()
    assert len(session.survivors()) > 4, 'bringup, its nodes, the shell and its driver'
    session.process.kill()
    assert session.wait() == -signal.SIGKILL
    wait_until(lambda: not session.survivors(), 'the guardian has stopped all')


def test_driver_elsewhere_is_awaited_and_ctrl_c_is_the_regular_end_of_an_endless_run(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    with ros_world(folder) as world:
        session = start(
            '--unlimited', '--driver', 'none', '--duration', 'inf',
            variables={'ROS_DOMAIN_ID': str(world.domain)},
        )
        wait_until(
            lambda: 'waiting for the driver' in session.stdout
            or session.process.poll() is not None, 'a word on the terminal',
        )
        assert f'ROS_DOMAIN_ID={world.domain} ' in session.stdout, session.stderr
        plant = world.start('plant')
        session.wait_for_samples()
        session.process.send_signal(signal.SIGINT)
        assert session.wait() == 0, session.stderr
        assert session.survivors() == {}
        assert 'SIGINT ends the run' in session.stderr
        assert plant.process.poll() is None
    assert json.loads((session.out / 'summary.json').read_text())['samples'] > 0


def test_ctrl_c_before_the_awaited_driver_came_is_a_failure(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    with ros_world(folder) as world:
        session = start(
            '--unlimited', '--driver', 'none', '--duration', 'inf',
            variables={'ROS_DOMAIN_ID': str(world.domain)},
        )
        wait_until(lambda: len(session.survivors()) > 3, 'nodes exist')
        session.process.send_signal(signal.SIGINT)
        assert session.wait() == 1
        assert session.survivors() == {}
        assert 'interrupted by SIGINT' in session.stderr


def plan(folder: Path, driver: str, *names: str, **values: object) -> RunPlan:
    """A plan of axes whose driver is the same text."""
    parameters = effective_parameters(None).replaced({'driver': driver, **values})
    return RunPlan(tuple(
        AxisPlan(name, parameters, folder / name, record=True) for name in names or ('',)
    ), folder)


def names_of(stages: list[list[ProcessPlan]]) -> list[list[str]]:
    return [[process.name for process in stage] for stage in stages]


def test_plant_stops_first_but_a_driver_only_after_the_controller(tmp_path: Path) -> None:
    assert names_of(plan_processes(plan(tmp_path, ''), None)) == [
        ['plant'], ['reference'], ['controller'], ['recorder'],
    ]
    stages = plan_processes(plan(tmp_path, 'run it', sample_period=0.05), None)
    assert names_of(stages) == [['controller'], ['driver'], ['reference'], ['recorder']]
    assert stages[1][0].command == ('run', 'it')
    assert stages[1][0].linger_s == pytest.approx(0.1)
    slow = plan_processes(plan(tmp_path, 'run it', **{'timeout.ramp': 20.0}), None)
    assert [stage[0].farewell_s for stage in slow] == [20.0, 0.0, 0.0, 0.0]
    assert names_of(plan_processes(plan(tmp_path, 'none'), None)) == [
        ['controller'], [], ['reference'], ['recorder'],
    ]


def test_axes_with_the_same_command_share_one_driver(tmp_path: Path) -> None:
    stages = plan_processes(plan(tmp_path, 'both --axes', 'x', 'y'), None)
    assert names_of(stages) == [
        ['x/controller', 'y/controller'], ['driver of x, y'], ['x/reference', 'y/reference'],
        ['x/recorder', 'y/recorder'],
    ]
    assert stages[1][0].log == tmp_path / 'logs' / 'x_y.log'


@pytest.fixture
def small(tmp_path: Path) -> Callable[..., list[list[ProcessPlan]]]:
    """Stages of one small Python program each."""
    def stages(*programs: str, **changes: object) -> list[list[ProcessPlan]]:
        environment = child_environment(tmp_path, None)
        return [
            [ProcessPlan(
                f'program {i}', (sys.executable, '-c', program), tmp_path / f'{i}.log',
                environment, foreign=True, **changes,  # type: ignore[arg-type]
            )] for i, program in enumerate(programs)
        ]
    return stages


ON_SIGINT = (
    'import os, signal, time; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]);'
    'open({begun!r}, "w").close(); signal.sigwait([signal.SIGINT]);'
)


def started(files: list[Path]) -> None:
    wait_until(lambda: all(file.exists() for file in files), 'all programs have begun')


def test_next_stage_is_left_alone_until_the_one_before_has_gone(
    small: Callable[..., list[list[ProcessPlan]]], tmp_path: Path,
) -> None:
    begun = [tmp_path / 'begun0', tmp_path / 'begun1']
    gone = str(tmp_path / 'gone')
    stages = small(
        ON_SIGINT.format(begun=str(begun[0])) + f'time.sleep(0.3); open({gone!r}, "w").close()',
        ON_SIGINT.format(begun=str(begun[1])) + f'print(os.path.exists({gone!r}))',
    )
    with ProcessSupervisor(stages, lambda: False) as supervisor:
        started(begun)
        supervisor.stop()
    assert (tmp_path / '1.log').read_text() == 'True\n'


def test_process_with_a_long_farewell_gets_the_time_for_it(
    small: Callable[..., list[list[ProcessPlan]]], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process_groups, 'ESCALATION', ((signal.SIGINT, 0.1), (signal.SIGKILL, 3.0)))
    begun = tmp_path / 'begun'
    ramp = ON_SIGINT.format(begun=str(begun)) + 'time.sleep(0.5); print("at zero")'
    with ProcessSupervisor(small(ramp, farewell_s=DEADLINE_S), lambda: False) as supervisor:
        started([begun])
        supervisor.stop()
    assert (tmp_path / '0.log').read_text() == 'at zero\n'


def test_driver_that_ignores_sigint_gets_ever_firmer_signals(
    small: Callable[..., list[list[ProcessPlan]]], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process_groups, 'ESCALATION', (
        (signal.SIGINT, 0.2), (signal.SIGTERM, 0.2), (signal.SIGKILL, DEADLINE_S),
    ))
    begun = [tmp_path / 'begun0', tmp_path / 'begun1']
    deaf = 'import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN);'
    rest = 'open({!r}, "w").close(); time.sleep(600)'
    stages = small(
        deaf + rest.format(str(begun[0])),
        deaf + 'signal.signal(signal.SIGTERM, signal.SIG_IGN);' + rest.format(str(begun[1])),
    )
    with ProcessSupervisor(stages, lambda: False) as supervisor:
        started(begun)
        supervisor.stop()
        codes = [child.process.returncode for child in supervisor.children]
    assert codes == [-signal.SIGTERM, -signal.SIGKILL]


def test_foreign_program_gets_no_variables_that_were_made_for_this_python() -> None:
    own, user = f'{sys.prefix}/lib', '/opt/user/lib'
    made = {
        '_ROS_WHEELS_BOOTSTRAP_COMPLETE': '1', 'BACKLASH_ROS_EVENTS': '1', 'HOME': '/home',
        'LD_LIBRARY_PATH': os.pathsep.join([own, user]),
    }
    assert foreign_environment(made) == {'HOME': '/home', 'LD_LIBRARY_PATH': user}
    del made['_ROS_WHEELS_BOOTSTRAP_COMPLETE']
    assert foreign_environment(made)['LD_LIBRARY_PATH'] == made['LD_LIBRARY_PATH']


READY = 'print(\'{"event": "ready"}\', flush=True)'
PROGRESS = 'print(\'{{"event": "progress", "sample": {}}}\', flush=True)'


@pytest.fixture
def watched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> Callable[..., tuple[str, str]]:
    """Failure and stderr of a run of 100 samples whose processes are small programs."""
    def watch(
        text: str = 'some command', managed: bool = False, **programs: str,
    ) -> tuple[str, str]:
        run_plan = plan(tmp_path, text, samples=100, autostart=not managed)
        environment = child_environment(tmp_path, None)
        block = 'import signal, time; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]);'
        stages = [
            [ProcessPlan(
                name, (sys.executable, '-c', f'{block}{program}\nsignal.sigwait([signal.SIGINT])'),
                tmp_path / f'{name}.log', environment, foreign=name == 'driver',
            )] for name, program in programs.items()
        ]
        with ProcessSupervisor(stages, lambda: False) as supervisor:
            displays = {'': ProgressDisplay(100, 0.01, sys.stderr)}
            run = supervision.Run(run_plan, supervisor, StopRequests(), displays)
            run.execute()
        return run.failure, capsys.readouterr().err
    return watch


def test_samples_of_a_driver_that_ran_before_count_from_the_first_one_heard(
    watched: Callable[..., tuple[str, str]],
) -> None:
    recorder = f'{READY}; {PROGRESS.format(5000)}; {PROGRESS.format(5099)}'
    assert watched(recorder=recorder)[0] == ''


def test_too_few_samples_of_a_driver_are_an_error_when_the_time_is_over(
    watched: Callable[..., tuple[str, str]], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(axis_progress, 'LATE_DEADLINE_S', 0.5)
    monkeypatch.setattr(axis_progress, 'STALL_DEADLINE_S', 0.1)
    failure, said = watched(recorder=f'{READY}; {PROGRESS.format(7)}; {PROGRESS.format(48)}')
    assert failure.startswith('only 42 of 100 samples')
    # A silent driver may come back: that alone does not end the run.
    assert said.count('no new sample for 0.12 s after sample 48, waiting for the driver') == 1


def test_driver_without_a_first_sample_is_an_error(
    watched: Callable[..., tuple[str, str]], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(axis_progress, 'FIRST_SAMPLE_DEADLINE_S', 1.0)
    failure, _ = watched(recorder=READY)
    assert failure.startswith('no sample within 1 s: does the driver publish its output?')


@pytest.mark.parametrize(('driver', 'managed', 'patient'), [
    ('some command', False, False), ('none', False, True), ('some command', True, True),
])
def test_controller_may_take_its_time_only_if_somebody_else_has_to_come(
    watched: Callable[..., tuple[str, str]], monkeypatch: pytest.MonkeyPatch,
    driver: str, managed: bool, patient: bool,
) -> None:
    monkeypatch.setattr(supervision, 'READY_DEADLINE_S', 0.1)
    # In one piece, so that the first sample is there with the word that it is ready.
    words = '\\n'.join(
        ['{"event": "ready"}', *(f'{{"event": "progress", "sample": {k}}}' for k in (0, 99))]
    )
    failure, _ = watched(driver, managed, controller=f"time.sleep(0.5); print('{words}')")
    if patient:
        assert failure == ''
    else:
        assert failure.startswith('not ready within 0.1 s: controller (')


@pytest.mark.parametrize(('outputs', 'told'), [(0, 1), (3, 0)])
def test_bag_without_outputs_of_the_driver_is_said_with_the_cause(
    watched: Callable[..., tuple[str, str]], outputs: int, told: int,
) -> None:
    closed = json.dumps({
        'event': 'closed', 'messages': {'/plant_output': outputs, '/plant/truth': 0}, 'failure': '',
    })
    failure, said = watched(recorder=(
        f'{READY}; {PROGRESS.format(0)}; {PROGRESS.format(99)}\n'
        f'signal.sigwait([signal.SIGINT]); print({closed!r}, flush=True); raise SystemExit'
    ))
    assert failure == ''
    assert said.count('no message of /plant_output') == told
    assert said.count('did not discover its publisher') == told


def test_odd_exit_code_of_a_driver_that_was_told_to_end_is_said_and_no_error(
    watched: Callable[..., tuple[str, str]], tmp_path: Path,
) -> None:
    begun = str(tmp_path / 'begun')
    driver = (
        f'open({begun!r}, "w").close(); signal.sigwait([signal.SIGINT]);'
        'raise SystemExit("good-bye")'
    )
    recorder = (
        'import os\n'
        f'while not os.path.exists({begun!r}): time.sleep(0.01)\n'
        f'{READY}; {PROGRESS.format(0)}; {PROGRESS.format(99)}'
    )
    failure, said = watched(driver=driver, recorder=recorder)
    assert failure == ''
    assert 'driver was stopped and ended with exit code 1, the end of' in said
    assert 'good-bye' in said
