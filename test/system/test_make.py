"""What make says where something is missing: one line that names it and its cure."""

from __future__ import annotations

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


def test_make_names_a_missing_python(bare_clone: Path) -> None:
    line = one_line_of_ours(make('demo', 'PYTHON=python3.99', cwd=bare_clone))
    assert "no 'python3.99' here" in line
    assert 'make ... PYTHON=' in line


def test_make_names_a_python_that_is_too_old(bare_clone: Path) -> None:
    old = bare_clone / 'python-old'
    old.write_text('#!/bin/sh\nexit 1\n')
    old.chmod(0o755)
    line = one_line_of_ours(make('demo', f'PYTHON={old}', cwd=bare_clone))
    assert 'is older than Python 3.10' in line


def test_make_names_a_sourced_ros_that_is_not_jazzy(bare_clone: Path) -> None:
    done = make('demo', f'PYTHON={BASE_PYTHON}', cwd=bare_clone, ROS_DISTRO='humble')
    line = one_line_of_ours(done)
    assert 'ROS_DISTRO=humble' in line
    assert 'jazzy' in line


def test_make_names_a_jazzy_without_rclpy(bare_clone: Path) -> None:
    done = make('demo', f'PYTHON={BASE_PYTHON}', cwd=bare_clone, ROS_DISTRO='jazzy')
    assert 'cannot import rclpy' in one_line_of_ours(done)


def test_make_names_an_unreachable_package_index(bare_clone: Path) -> None:
    # Nothing listens on port 9 (discard) of this machine: the connection is refused at once.
    done = make(
        'demo', f'PYTHON={BASE_PYTHON}', cwd=bare_clone, PIP_INDEX_URL='http://127.0.0.1:9/',
        PIP_CONFIG_FILE=os.devnull, PIP_RETRIES='1', PIP_FIND_LINKS='',
    )
    assert 'connect to the network' in one_line_of_ours(done)
    assert not (bare_clone / '.venv' / 'backlash_ros.json').exists()


def test_make_test_runs_the_linters_and_passes_arguments_on(bare_clone: Path) -> None:
    done = make('--dry-run', 'test', 'ARGS=-x test/system/test_make.py', cwd=bare_clone)
    modules = [line.split('-m ', 1)[1] for line in done.stdout.splitlines() if ' -m ' in line]
    assert [module.split()[0] for module in modules] == ['ruff', 'mypy', 'pytest']
    assert modules[-1].endswith(' -x test/system/test_make.py')
