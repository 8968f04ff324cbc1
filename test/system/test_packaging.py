"""The package built by colcon and started from its installation."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from places import ROOT
from ros_processes import ros_world
from std_msgs.msg import Float64
from waiting import DEADLINE_S

EXECUTABLES = {
    'controller', 'plant', 'reference', 'recorder', 'bringup', 'simulate', 'report', 'compare',
    'check_driver', 'identify', 'replay', 'monitor', 'live',
}
COLCON = 'import sys; from colcon_core.command import main; sys.exit(main())'
HOMES = """
import sys
from importlib.metadata import distribution
for entry in distribution("backlash_ros").entry_points:
    assert callable(entry.load())
    print(entry.name, sys.modules[entry.module].__file__)
"""


def output_of(*command: object, **options: object) -> str:
    done = subprocess.run(  # type: ignore[call-overload]
        list(map(str, command)), capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)


def colcon(folder: Path, *arguments: object) -> str:
    return output_of(sys.executable, '-c', COLCON, '--log-base', folder / 'log', *arguments,
                     '--paths', ROOT, cwd=folder)


def test_colcon_installs_what_the_tools_look_for_and_it_runs(tmp_path: Path) -> None:
    assert colcon(tmp_path, 'list').split() == ['backlash_ros', str(ROOT), '(ros.ament_python)']
    colcon(tmp_path, 'build', '--build-base', tmp_path / 'build',
           '--install-base', tmp_path / 'install')
    installation = tmp_path / 'install' / 'backlash_ros'
    share = installation / 'share'
    marker = share / 'ament_index' / 'resource_index' / 'packages' / 'backlash_ros'
    assert marker.is_file()
    assert (share / 'backlash_ros' / 'package.xml').is_file()
    for folder, pattern in (
        ('config', '*'), ('launch', '*.py'), ('examples', '*.py'), ('docs', '*.md'),
        ('docs/images', '*'), ('docs/reference', '*.md'), ('docs/results', '*.md'),
        ('docs/results/images', '*'),
    ):
        shipped, own = (
            {path.name: path.is_file() and path.read_bytes()
             for path in (base / folder).glob(pattern)} for base in (share / 'backlash_ros', ROOT))
        assert shipped == own != {}
    beside_modules = {path.name for path in installation.rglob('lib/python*/**/*')
                      if path.suffix in ('.html', '.md', '.mplstyle', '.xml')}
    assert beside_modules == {'comparison.md', 'figures.mplstyle', 'live.html', 'loopback.xml',
                              'network.xml', 'page.html'}
    executables = installation / 'lib' / 'backlash_ros'
    assert {path.name for path in executables.iterdir() if os.access(path, os.X_OK)} == EXECUTABLES
    script = f'. "{installation.parent}/local_setup.bash" && env -0'
    sourced = dict(
        line.split('=', 1) for line in output_of('bash', '-c', script).split('\0') if '=' in line)
    homes = output_of(sys.executable, '-c', HOMES, cwd=tmp_path, env=sourced)
    files = dict(line.split(' ', 1) for line in homes.splitlines())
    assert set(files) == EXECUTABLES
    assert all(Path(path).is_relative_to(installation) for path in files.values())
    out = tmp_path / 'out'
    output_of(executables / 'simulate', '--duration', '1', '--out', out, cwd=tmp_path, env=sourced)
    assert (out / 'summary.json').is_file()
    with ros_world(tmp_path) as world, (tmp_path / 'controller.log').open('wb') as log:
        probe = world.probe()
        commands = probe.collect('control', Float64)
        reference, output = (probe.publisher(name, Float64) for name in (
            'reference', 'plant_output'))
        controller = subprocess.Popen(
            executables / 'controller', cwd=tmp_path, stdout=log, stderr=log,
            env={**sourced, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                 'ROS_DOMAIN_ID': str(world.domain)})
        def answered() -> bool:
            reference.publish(Float64(data=1.0))
            output.publish(Float64(data=0.0))
            return bool(commands) or controller.poll() is not None
        try:
            probe.wait_until(answered, 'an answer')
            controller.send_signal(signal.SIGINT)
            assert controller.wait(DEADLINE_S) == 0, (tmp_path / 'controller.log').read_text()
        finally:
            controller.kill()
            controller.wait()
    assert commands
