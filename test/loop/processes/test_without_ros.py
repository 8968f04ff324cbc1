"""Without ROS 2: what works with the declared requirements alone, and what says why it does not."""

import os
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from places import ROOT

PACKAGE = 'backlash_ros'
SCRIPT = """
from backlash_ros.core import (
    Estimate, Parameters, Status, build_closed_loop, build_controller, build_plant, build_reference,
    fit_record,
)
print(build_closed_loop(Parameters()).run(300).column('c_r')[-1])
"""
TOOLS = """
from backlash_ros.tools import compare as compare
from backlash_ros.tools import report as report
from backlash_ros.tools import simulate as simulate
assert simulate.main(['--duration', '1', '--out', 'simulate']) == 0
assert compare.main(['--duration', '1', '--out', 'compare']) == 0
"""


def declared(name: str, known: set[str]) -> set[str]:
    """The distributions that a distribution needs, itself included."""
    known.add(name)
    for text in distribution(name).requires or []:
        requirement = Requirement(text)
        wanted = requirement.marker is None or requirement.marker.evaluate({'extra': ''})
        if wanted and requirement.name not in known:
            declared(requirement.name, known)
    return known


@pytest.fixture(scope='module')
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the package and what its setup.py asks for, and nothing else."""
    folder = tmp_path_factory.mktemp('libraries')
    (folder / PACKAGE).symlink_to(ROOT / PACKAGE)
    for name in declared(PACKAGE, set()) - {PACKAGE}:
        files = distribution(name).files or []
        for first in {path.parts[0] for path in files} - {'..', '__pycache__'}:
            if not (folder / first).exists():
                (folder / first).symlink_to(Path(str(distribution(name).locate_file(first))))
    return folder


def called(libraries: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # -S: nothing that is installed for this interpreter is there.
    environment = {
        name: value for name, value in os.environ.items()
        if not name.startswith(('ROS_', '_ROS', 'AMENT_', 'LD_LIBRARY_PATH'))
    }
    return subprocess.run(
        [sys.executable, '-S', *arguments], cwd=folder, capture_output=True, text=True,
        env={**environment, 'PYTHONPATH': str(libraries)}, timeout=500,
    )


def test_what_needs_no_ros_works_and_the_rest_says_so_in_one_line(libraries, tmp_path):
    for module in ('nodes.controller', 'nodes.check_driver', 'nodes.live', 'tools.bringup'):
        done = called(libraries, tmp_path, '-m', f'{PACKAGE}.{module}')
        assert done.returncode == 1
        assert 'rclpy is missing: source ROS 2 Jazzy' in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
    done = called(libraries, tmp_path, '-c', SCRIPT)
    assert (done.returncode, done.stderr) == (0, '')
    assert float(done.stdout) == pytest.approx(3.0, rel=1e-3)
    done = called(libraries, tmp_path, '-c', TOOLS)
    assert (done.returncode, done.stderr) == (0, '')
    assert (tmp_path / 'simulate' / 'report.html').is_file()
    assert (tmp_path / 'compare' / 'comparison.md').is_file()
