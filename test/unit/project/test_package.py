"""What the package names: files, versions, constants, what a script without ROS may import."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT

import backlash_ros
import backlash_ros.core as core

ROS_PREFIXES = ('rclpy', 'ament_')
ROS_SUFFIXES = ('_msgs', '_srvs', '_interfaces')


def test_launch_file_names_executables_that_are_installed() -> None:
    tree = ast.parse((ROOT / 'launch' / 'backlash.launch.py').read_text())
    launched = {
        ast.literal_eval(call.args[0]) for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == 'node'}
    assert launched == {'controller', 'reference', 'recorder', 'plant'}


SEEN_BY_NUMPY = """
import importlib, os, sys
class Watch:  # of the moment at which numpy begins to be loaded
    def find_spec(self, name, path=None, target=None):
        if name == 'numpy' and not seen:
            seen.append(os.environ.get('OMP_NUM_THREADS'))
seen = []
sys.meta_path.insert(0, Watch())
importlib.import_module(sys.argv[1])
importlib.import_module('numpy')
print(*seen)
"""


@pytest.mark.parametrize(('given', 'seen'), [(None, '1'), ('3', '3')])
@pytest.mark.parametrize('module', [
    'backlash_ros.nodes.controller', 'backlash_ros.tools.simulate',
    'backlash_ros.tools.identify.command'])
def test_linear_algebra_has_one_thread_unless_the_user_wants_more(
    module: str, given: str | None, seen: str,
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != 'OMP_NUM_THREADS'}
    environment |= {} if given is None else {'OMP_NUM_THREADS': given}
    done = subprocess.run([sys.executable, '-c', SEEN_BY_NUMPY, module], cwd=ROOT, text=True,
                          env=environment, capture_output=True, check=True)
    assert done.stdout.split() == [seen]


def test_package_xml_names_every_imported_ros_package() -> None:
    tree = ElementTree.parse(ROOT / 'package.xml')
    declared = {element.text for element in tree.iter('exec_depend')}
    imported = {
        module
        for path in ROOT.glob('backlash_ros/**/*.py')
        for module in re.findall(r'^ *(?:from|import) (\w+)', path.read_text(), re.MULTILINE)}
    ros = {
        name for name in imported
        if name.startswith(ROS_PREFIXES) or name.endswith(ROS_SUFFIXES)}
    assert 'rclpy' in ros
    assert ros <= declared


def test_package_xml_setup_and_module_name_one_version() -> None:
    package_xml = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    tree = ast.parse((ROOT / 'setup.py').read_text())
    (setup,) = (
        ast.literal_eval(node.value) for node in ast.walk(tree)
        if isinstance(node, ast.keyword) and node.arg == 'version')
    assert package_xml == setup == backlash_ros.__version__


def constants(path: Path) -> Iterator[str]:
    for node in ast.parse(path.read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else (
            [node.target] if isinstance(node, ast.AnnAssign) else [])
        for target in targets:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and name.id.lstrip('_').isupper():
                    yield name.id


def test_constant_has_one_home_in_the_package() -> None:
    package = ROOT / 'backlash_ros'
    homes = defaultdict(set)
    for path in package.rglob('*.py'):
        for name in constants(path):
            homes[name].add(path.relative_to(package).as_posix())
    assert len(homes) > 100
    twice = {name: sorted(files) for name, files in homes.items() if len(files) > 1}
    assert twice == {}


@pytest.mark.parametrize('name', core.__all__)
def test_every_public_name_is_there(name: str) -> None:
    found = getattr(core, name)
    assert found.__module__.startswith('backlash_ros.core.')
    # That of a class without one would be its parent's.
    assert vars(found).get('__doc__') or (inspect.isfunction(found) and found.__doc__)


def test_example_of_the_package_runs(capsys: pytest.CaptureFixture[str]) -> None:
    code = '\n'.join(line.strip() for line in core.__doc__.splitlines()[2:])
    exec(code, {})
    assert 2.0 < float(capsys.readouterr().out) < 4.0
