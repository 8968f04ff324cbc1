"""Processes that do not end by themselves, and what is said where something is missing."""

import os
import shutil
import signal
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from places import ROOT
from waiting import DEADLINE_S

from backlash_ros.tools.cli import StopRequests

# Calls of a PyDLL keep the interpreter locked, as Fast DDS does when it hangs.
LEAVE = """
import ctypes, sys, time
from backlash_ros.nodes.runtime.process import exit_at_the_latest
with exit_at_the_latest(0.5, 9):
    pass
time.sleep(0.7)
print('all that was to be said')
with exit_at_the_latest(0.5, 3):
    ctypes.PyDLL(None).pause()
"""


def test_a_process_ends_though_the_interpreter_is_locked() -> None:
    done = subprocess.run(
        (sys.executable, '-c', LEAVE), timeout=DEADLINE_S,
        capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (3, 'all that was to be said\n'), done.stderr


def test_a_ctrl_c_that_comes_twice_at_once_counts_once() -> None:
    with StopRequests() as requests:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
        assert (requests.count, requests.last) == (1, 'SIGINT')


# The interpreter beneath the environment that runs the tests: without packages, so without rclpy.
BASE_PYTHON = f'{sys.base_prefix}/bin/python3.{sys.version_info.minor}'
# Of the caller, these would change what is asked here.
NOT_INHERITED = {'ROS_DISTRO', 'PYTHONPATH', 'PYTHON', 'MAKEFLAGS', 'MFLAGS', 'MAKELEVEL'}


def make(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {name: value for name, value in os.environ.items() if name not in NOT_INHERITED}
    return subprocess.run(
        ['make', *arguments],
        cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True)


@pytest.fixture
def bare_clone(tmp_path: Path) -> Path:
    for name in ('Makefile', 'setup.py', 'setup.cfg'):
        shutil.copy(ROOT / name, tmp_path)
    for name in ('scripts', 'requirements'):
        shutil.copytree(ROOT / name, tmp_path / name)
    return tmp_path


def one_line_of_ours(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if not line.startswith('make')]
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_make_names_what_is_missing_and_its_cure_in_one_line(bare_clone: Path) -> None:
    old = bare_clone / 'python-old'
    old.write_text('#!/bin/sh\nexit 1\n')
    old.chmod(0o755)
    base = f'PYTHON={BASE_PYTHON}'
    # Nothing listens on port 9 (discard) of this machine: the connection is refused at once.
    offline = {'PIP_INDEX_URL': 'http://127.0.0.1:9/', 'PIP_CONFIG_FILE': os.devnull,
               'PIP_RETRIES': '1', 'PIP_FIND_LINKS': ''}
    for python, environment, words in (
        ('PYTHON=python3.99', {}, ["no 'python3.99' here", 'make ... PYTHON=']),
        (f'PYTHON={old}', {}, ['is older than Python 3.10']),
        (base, {'ROS_DISTRO': 'humble'}, ['ROS_DISTRO=humble', 'jazzy']),
        (base, {'ROS_DISTRO': 'jazzy'}, ['cannot import rclpy']),
        (base, offline, ['connect to the network']),
    ):
        line = one_line_of_ours(make('demo', python, cwd=bare_clone, **environment))
        for word in words:
            assert word in line
    assert not (bare_clone / '.venv' / 'backlash_ros.json').exists()
    done = make('--dry-run', 'test', 'ARGS=-x test/unit', cwd=bare_clone)
    modules = [line.split('-m ', 1)[1] for line in done.stdout.splitlines() if ' -m ' in line]
    assert [module.split()[0] for module in modules] == ['ruff', 'mypy', 'pytest']
    assert modules[-1].endswith(' -x test/unit')


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
        if not name.startswith(('ROS_', '_ROS', 'AMENT_', 'LD_LIBRARY_PATH'))}
    return subprocess.run(
        [sys.executable, '-S', *arguments], cwd=folder, capture_output=True, text=True,
        env={**environment, 'PYTHONPATH': str(libraries)}, timeout=500)


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
