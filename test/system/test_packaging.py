"""The package built by colcon and started from its installation."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
import rclpy
from places import ROOT
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64

EXECUTABLES = {
    'controller', 'plant', 'reference', 'recorder', 'bringup', 'simulate', 'report', 'compare',
    'check_driver', 'identify', 'replay', 'monitor', 'live',
}
DEADLINE_S = 30.0
COLCON = [
    sys.executable, '-c', 'import sys; from colcon_core.command import main; sys.exit(main())'
]


def run_colcon(folder: Path, *arguments: str) -> str:
    """Return the standard output of colcon, run in an empty folder on this package."""
    command = [*COLCON, '--log-base', str(folder / 'log'), *arguments, '--paths', str(ROOT)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope='module')
def installation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `colcon build` installed the package into."""
    folder = tmp_path_factory.mktemp('workspace')
    run_colcon(
        folder, 'build', '--build-base', str(folder / 'build'),
        '--install-base', str(folder / 'install'),
    )
    return folder / 'install' / 'backlash_ros'


@pytest.fixture(scope='module')
def sourced(installation: Path) -> Mapping[str, str]:
    """The environment after `. install/local_setup.bash`."""
    script = f'. "{installation.parent}/local_setup.bash" && env -0'
    done = subprocess.run(['bash', '-c', script], capture_output=True, text=True, check=True)
    variables = dict(line.split('=', 1) for line in done.stdout.split('\0') if '=' in line)
    # A domain that no other test run on this machine is likely to use; above 101 ports collide.
    return {
        **variables,
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 101),
    }


@pytest.fixture
def driver_context(
    sourced: Mapping[str, str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Context]:
    """A ROS context in the domain of the `sourced` environment."""
    for name in ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_DOMAIN_ID'):
        monkeypatch.setenv(name, sourced[name])
    context = Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


def await_command(context: Context, controller: subprocess.Popen[bytes]) -> bool:
    """Act as a driver until the controller answers a plant output; False after the deadline."""
    node = rclpy.create_node('driver', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    commands: list[Float64] = []
    node.create_subscription(Float64, 'control', commands.append, 10)
    reference = node.create_publisher(Float64, 'reference', 10)
    plant_output = node.create_publisher(Float64, 'plant_output', 10)
    deadline = time.monotonic() + DEADLINE_S
    while not commands and controller.poll() is None and time.monotonic() < deadline:
        reference.publish(Float64(data=1.0))
        plant_output.publish(Float64(data=0.0))
        executor.spin_once(timeout_sec=0.01)
    executor.shutdown()
    node.destroy_node()
    return bool(commands)


def test_colcon_installs_what_the_tools_look_for_and_it_runs(
    installation: Path, sourced: Mapping[str, str], driver_context: Context, tmp_path: Path
) -> None:
    columns = run_colcon(tmp_path, 'list').split()
    assert columns == ['backlash_ros', str(ROOT), '(ros.ament_python)']
    share = installation / 'share'
    marker = share / 'ament_index' / 'resource_index' / 'packages' / 'backlash_ros'
    assert marker.is_file()
    assert (share / 'backlash_ros' / 'package.xml').is_file()
    installed = {path.name: path.read_bytes() for path in share.glob('backlash_ros/config/*')}
    assert installed
    assert installed == {path.name: path.read_bytes() for path in ROOT.glob('config/*')}
    for folder, pattern in (
        ('launch', '*.py'), ('examples', '*.py'), ('docs', '*.md'), ('docs/images', '*'),
        ('docs/reference', '*.md'), ('docs/results', '*.md'), ('docs/results/images', '*'),
    ):
        beside = {path.name for path in (share / 'backlash_ros' / folder).glob(pattern)}
        assert beside == {path.name for path in (ROOT / folder).glob(pattern)} != set()
    beside_modules = {path.name for path in installation.rglob('lib/python*/**/*.[hx]*ml')}
    assert beside_modules == {'loopback.xml', 'network.xml', 'page.html'}
    executables = installation / 'lib' / 'backlash_ros'
    assert {path.name for path in executables.iterdir()} == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in executables.iterdir())
    code = (
        'import inspect\n'
        'from importlib.metadata import distribution\n'
        'for entry in distribution("backlash_ros").entry_points:\n'
        '    print(entry.name, inspect.getfile(entry.load()))\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=tmp_path, env=sourced, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    files = dict(line.split(' ', 1) for line in done.stdout.splitlines())
    assert set(files) == EXECUTABLES
    assert all(Path(path).is_relative_to(installation) for path in files.values())
    command = [str(installation / 'lib' / 'backlash_ros' / 'simulate'), '--duration', '1']
    done = subprocess.run(
        [*command, '--out', str(tmp_path / 'out')],
        cwd=tmp_path, env=sourced, capture_output=True, text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / 'out' / 'summary.json').is_file()
    log = tmp_path / 'controller.log'
    with log.open('wb') as output:
        controller = subprocess.Popen(
            [installation / 'lib' / 'backlash_ros' / 'controller'],
            cwd=tmp_path, env=sourced, stdout=output, stderr=output,
        )
    try:
        answered = await_command(driver_context, controller)
        assert answered, log.read_text()
        controller.send_signal(signal.SIGINT)
        assert controller.wait(DEADLINE_S) == 0, log.read_text()
    finally:
        if controller.poll() is None:
            controller.kill()
        controller.wait()
