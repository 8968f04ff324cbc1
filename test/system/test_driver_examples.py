"""The example drivers beside real nodes, and the commands that docs/driver.md prints."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from bringup_processes import UNDRAWN
from places import ROOT
from waiting import DEADLINE_S

from backlash_ros.tools.bringup.supervisor import child_environment, free_domain

BLOCKS = re.findall(
    r'^```bash\n(.*?)^```', (ROOT / 'docs' / 'driver.md').read_text(), re.MULTILINE | re.DOTALL
)
# Beside these the commands that follow them are run.
FOREVER = ('motor_driver.py', 'bare_dds_driver.py', '/controller', '/reference')
SHORT_S = {'check_driver': '2', 'bringup': '1'}  # the pages give a user more time
NARROW = {'identify': ['--order', '1-2', '--delay', '0-1']}  # and search for more


def commands_of_driver_page() -> list[list[str]]:
    lines = [line for block in BLOCKS for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line)) and words[0] != 'export']


def runnable(words: list[str]) -> list[str]:
    program, *arguments = words
    name = program.removeprefix('.venv/bin/')
    modules = dict(
        re.findall(r"f'(\w+) = \{PACKAGE\}\.([\w.]+):main'", (ROOT / 'setup.py').read_text()))
    if name in SHORT_S and '--duration' in arguments:
        arguments[arguments.index('--duration') + 1] = SHORT_S[name]
    arguments += NARROW.get(name, [])
    arguments = [a.replace('.venv/bin/python', sys.executable) for a in arguments]
    if name == 'python':
        return [sys.executable, *arguments]
    if name in ('bringup', 'identify'):
        return [sys.executable, str(UNDRAWN), f'backlash_ros.{modules[name]}', *arguments]
    call = f'import sys; from backlash_ros.{modules[name]} import main; sys.exit(main())'
    return [sys.executable, '-c', call, *arguments]


def page_in_parts() -> list[list[list[str]]]:
    parts: list[list[list[str]]] = [[]]
    ended = False
    for words in commands_of_driver_page():
        forever = any(mark in ' '.join(words) for mark in FOREVER) and '--driver' not in words
        if forever and ended:
            parts.append([])
        ended = not forever
        parts[-1].append(words)
    return parts


def test_commands_of_the_driver_page_run_and_its_drivers_end_on_a_signal(tmp_path: Path) -> None:
    pytest.importorskip('cyclonedds')
    for name in ('examples', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    for part in page_in_parts():
        with free_domain() as domain:
            environment = child_environment(tmp_path, domain)
            started: list[subprocess.Popen[bytes]] = []
            try:
                for words in part:
                    run_or_start(words, environment, tmp_path, started)
                assert all(process.poll() is None for process in started)
                for process in started:
                    if '_driver.py' in process.args[1]:
                        process.terminate()
                        assert process.wait(DEADLINE_S) == 0, process.args
            finally:
                for process in started:
                    process.kill()
                    process.wait()
    found = json.loads((tmp_path / 'identified' / 'identified.json').read_text())
    assert found['gap'] == pytest.approx(0.9, abs=0.01)
    assert (found['c_r'], found['delay_samples']) == (pytest.approx(0.55, abs=0.01), 0)
    # m is 1 where nothing was said of it: G has the gain of both.
    gain = found['m'] * sum(found['numerator']) / sum(found['denominator'])
    assert gain == pytest.approx(0.098, rel=0.01)


def run_or_start(
    words: list[str], environment: dict[str, str], folder: Path,
    started: list[subprocess.Popen[bytes]],
) -> None:
    text = ' '.join(words)
    if any(mark in text for mark in FOREVER) and '--driver' not in words:
        started.append(subprocess.Popen(
            runnable(words), cwd=folder, env=environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL))
        return
    if '--driver' in words:
        for process in started:
            process.kill()
            process.wait()
        started.clear()
    done = subprocess.run(
        runnable(words), cwd=folder, env=environment, capture_output=True, text=True,
        timeout=DEADLINE_S)
    assert does_what_it_is_for(done), done.stdout + done.stderr


def does_what_it_is_for(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether a command has ended well.

    check_driver may find fault with the timing alone, and then need not judge what follows from it.
    """
    if any('check_driver' in word for word in done.args[:3]):
        marks = [line[0] for line in done.stdout.splitlines()
                 if line[2:].startswith(('sign and units', 'G(z)'))]
        late = any(f'✗ {what}' in done.stdout for what in ('rate', 'jitter', 'lost samples'))
        judged = len(marks) == 2 and set(marks) <= {'✓', '–' if late else '✓'}
        return judged and done.returncode in (0, 1)
    return bool(done.returncode == 0)
