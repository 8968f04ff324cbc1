"""The documents: links lead somewhere, what they name exists, what is made is current."""

import os
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import accuracy
import pytest
import yaml
from places import ROOT
from tables import parameters_page

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller
from backlash_ros.core.parameters import BY_NAME, Parameters
from backlash_ros.nodes.check_driver import parse_options
from backlash_ros.tools import batch
from backlash_ros.tools import compare as compare
from backlash_ros.tools import replay as replay
from backlash_ros.tools import report as report
from backlash_ros.tools import simulate as simulate
from backlash_ros.tools.bringup import __main__ as bringup
from backlash_ros.tools.config import flattened, read_configuration
from backlash_ros.tools.identify import command as identify

DOCS = ROOT / 'docs'
PAGES = sorted([ROOT / 'README.md', *DOCS.rglob('*.md')])
README = (ROOT / 'README.md').read_text()
BLOCK = re.compile(r'^```(\w+)\n(.*?)^```', re.MULTILINE | re.DOTALL)
PYTHON_C = re.compile(r"python3? -c '([^']+)'")
INSTALLED = re.compile(r'/lib/backlash_ros/(\w+)')
LINK = re.compile(r'\]\(([^)\s]+)\)')
CODE = re.compile(r'`([^`\n]+)`')
DOTTED = re.compile(r'[a-z_]+(\.[a-z_0-9]+)+')
GROUPS = {name.split('.')[0] for name in BY_NAME if '.' in name}
# Files of a result and topics share their first word with a group of parameters.
FILE_ENDINGS = {'py', 'yaml', 'json', 'csv', 'md', 'html', 'txt'}


def of_every_page(pattern: re.Pattern[str]) -> Iterator[tuple[Path, str]]:
    for page in PAGES:
        for found in pattern.finditer(page.read_text()):
            yield page, found[1]


def shell_commands() -> list[list[str]]:
    scripts = '|'.join(console_scripts())
    command = re.compile(
        rf'(make [a-z]|(.venv/bin/)?(python3? (?!-m)\S+|({scripts}) [-\w])|ros2 run backlash_ros)')
    found = [
        (language, line)
        for page in PAGES for language, text in BLOCK.findall(page.read_text())
        if language in ('bash', 'sh', 'text')
        for line in text.replace('\\\n', ' ').splitlines()]
    found += [('text', code) for _, code in of_every_page(CODE)]
    lines = [
        line for language, line in found if language != 'text'
        or (command.match(line) and not re.search(r'NAME|FILE|HOST|\.\.\.|[^ -~]', line))]
    words = {line: shlex.split(line, comments=True) for line in lines}
    return [line for line in words.values() if line]


def console_scripts() -> set[str]:
    return set(re.findall(r"f'(\w+) = \{PACKAGE\}", (ROOT / 'setup.py').read_text()))


def anchors(page: Path) -> set[str]:
    headings = re.findall(r'^#+ (.*)$', page.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_links_lead_to_files_and_headings() -> None:
    broken = []
    for page, link in of_every_page(LINK):
        if '://' in link:
            continue
        path, _, anchor = link.partition('#')
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(f'{page.name}: {link}')
    assert broken == []


def test_every_picture_is_shown() -> None:
    shown = {(page.parent / link).resolve() for page, link in of_every_page(LINK)}
    assert set((DOCS / 'images').iterdir()) <= shown


def test_page_of_parameters_is_current() -> None:
    assert (DOCS / 'reference' / 'parameters.md').read_text() == parameters_page(), 'call make docs'


def test_every_row_of_the_contract_has_a_reference_and_a_section_of_the_page() -> None:
    reference, alone = accuracy.Reference.read(), [n for n, r in accuracy.ROWS.items() if r.alone]
    assert list(reference.rows) == [name for name in accuracy.ROWS if name not in alone]
    assert reference.times
    assert all(list(rows) == alone for rows in reference.times.values())
    sections = re.findall('^## (.+)$', accuracy.PAGE.read_text(), re.MULTILINE)
    assert sections == [name.capitalize() for name in accuracy.ROWS]


def test_parameters_that_pages_name_exist() -> None:
    named = {
        code for _, code in of_every_page(CODE)
        if DOTTED.fullmatch(code) and code.split('.')[0] in GROUPS
        and code.split('.')[-1] not in FILE_ENDINGS}
    groups = {name.rsplit('.', 1)[0] for name in BY_NAME if '.' in name}
    assert named & set(BY_NAME)
    assert named <= set(BY_NAME) | groups


@pytest.mark.parametrize('words', shell_commands(), ids=' '.join)
def test_command_exists_and_takes_its_arguments(words: list[str]) -> None:
    program, *arguments = words
    if program == 'make':
        targets = re.findall(r'^(\w+):', (ROOT / 'Makefile').read_text(), re.MULTILINE)
        assert arguments[0] in targets
    elif program == 'ros2':
        assert arguments[:2] == ['run', 'backlash_ros']
        assert arguments[2] in console_scripts()
    elif program in ('rosdep', 'colcon', '.', 'export', 'cp') or '=' in program:
        assert program != 'colcon' or arguments[-1] == 'backlash_ros'
        if program == 'cp':
            shipped = arguments[0].removeprefix('$(ros2 pkg prefix --share backlash_ros)/')
            assert (ROOT / shipped).is_file()
    elif program.removeprefix('.venv/bin/') in ('python', 'python3'):
        if arguments[0] != '-c':
            source = (ROOT / arguments[0]).read_text()
            options = {word for word in arguments if word.startswith('--')}
            assert {option for option in options if option not in source} == set()
    else:
        assert program.removeprefix('.venv/bin/') in console_scripts()
        check_tool(program.removeprefix('.venv/bin/'), arguments)


def check_tool(program: str, arguments: list[str]) -> None:
    if program in ('monitor', 'live') or arguments[:1] == ['--repair']:
        return
    if program in ('controller', 'plant', 'reference', 'recorder'):
        assert arguments[:2] == ['--ros-args', '--params-file']
        assert (ROOT / arguments[2]).is_file()
        return
    tool: dict[str, Any] = {
        'compare': compare, 'report': report, 'identify': identify, 'replay': replay,
        'simulate': simulate}
    options = (
        bringup.parse_options(arguments) if program == 'bringup' else
        parse_options(arguments) if program == 'check_driver' else
        tool[program].make_parser().parse_args(arguments))
    # Another command, or the user, writes these files.
    elsewhere = ('identified.yaml', 'limits.yaml', 'my_actuator.yaml')
    if options.config is not None and Path(options.config).name in elsewhere:
        return
    if program in ('simulate', 'bringup'):
        build_controller(read_configuration(
            options.config, options.settings, options.seed).parameters(options.axis))
    else:
        assert options.config is None or (ROOT / options.config).is_file()
    for sweep in getattr(options, 'sweep', []):
        batch.combinations([sweep])


@pytest.mark.usefixtures('undrawn')
def test_commands_that_need_no_ros_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: {0}, raising=False)
    mains: dict[str, Callable[[list[str]], int]] = {
        'simulate': simulate.main, 'report': report.main, 'replay': replay.main}
    done = []
    # `replay` needs a run, of which a sweep of simulations leaves none.
    for program, *arguments in sorted(
        shell_commands(), key=lambda words: 'simulate' not in words[0] or '--sweep' not in words
    ):
        main = mains.get(program.removeprefix('.venv/bin/'))
        if main is None or {'log.csv', 'bag', 'identified/identified.yaml'} & set(arguments):
            continue  # those of a user
        arguments = [a.replace('config/', '') for a in arguments]  # as it is shipped
        short = ['--duration', '0.5'] if main is simulate.main else []
        assert main([*arguments, *short]) == 0, arguments
        done.append(program)
    assert len(done) > 10


def blocks(*languages: str) -> list[str]:
    return [
        text for page in PAGES for language, text in BLOCK.findall(page.read_text())
        if language in languages]


@pytest.mark.parametrize('text', blocks('python') + [
    snippet for text in blocks('bash', 'sh', 'ini') for snippet in PYTHON_C.findall(text)])
def test_python_of_the_pages_runs(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    exec(text, {})


def test_files_that_pages_show_are_valid() -> None:
    for text in blocks('xml'):
        ElementTree.fromstring(text)
    for text in blocks('yaml'):
        for section in yaml.safe_load(text).values():
            Parameters(dict(flattened(section['ros__parameters'])))
    started = [name for text in blocks('ini') for name in INSTALLED.findall(text)]
    assert started
    assert set(started) <= console_scripts()
    assert not {language for page in PAGES for language, _ in BLOCK.findall(page.read_text())} - {
        'bash', 'sh', 'ini', 'python', 'text', 'xml', 'yaml'}


def test_readme_names_every_executable_and_topic() -> None:
    codes = set(CODE.findall(README))
    assert console_scripts() <= codes
    named = [value for name, value in vars(topics).items() if name.isupper()]
    assert {name for name in named if isinstance(name, str)} <= codes
