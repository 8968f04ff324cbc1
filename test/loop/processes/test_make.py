"""What make says where something is missing: one line that names it and its cure."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

# The interpreter beneath the environment that runs the tests: without packages, so without rclpy.
BASE_PYTHON = f'{sys.base_prefix}/bin/python3.{sys.version_info.minor}'
# Of the caller, these would change what is asked here.
NOT_INHERITED = {'ROS_DISTRO', 'PYTHONPATH', 'PYTHON', 'MAKEFLAGS', 'MFLAGS', 'MAKELEVEL'}


def make(*arguments: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {name: value for name, value in os.environ.items() if name not in NOT_INHERITED}
    return subprocess.run(
        ['make', *arguments],
        cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True,
    )


@pytest.fixture
def bare_clone(tmp_path: Path) -> Path:
    """What make needs to create an environment, without one."""
    for name in ('Makefile', 'setup.py', 'setup.cfg'):
        shutil.copy(ROOT / name, tmp_path)
    for name in ('scripts', 'requirements'):
        shutil.copytree(ROOT / name, tmp_path / name)
    return tmp_path


def one_line_of_ours(done: subprocess.CompletedProcess[str]) -> str:
    """Return the only line of standard error besides those that make itself adds."""
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
