"""Linters, strict types, and one version number in three places."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import backlash_ros

ROOT = Path(__file__).resolve().parents[1]


def run_module(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def setup_keyword(name: str) -> object:
    """Return the literal value of a keyword argument of setup() in setup.py."""
    for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg == name:
            return ast.literal_eval(node.value)
    raise KeyError(name)


def test_ruff_finds_nothing() -> None:
    done = run_module('ruff', 'check', '--output-format', 'concise', '.')
    assert done.returncode == 0, done.stdout + done.stderr


def unpinned_libraries() -> list[str]:
    """Return the run-time libraries that are here in another version than requirements/ pins."""
    lines = (ROOT / 'requirements' / 'run.txt').read_text().splitlines()
    pins = dict(line.split('==') for line in lines if '==' in line)
    here = {name: importlib.metadata.version(name) for name in pins}
    return [f'{name} {here[name]}' for name in pins if here[name] != pins[name]]


def test_strict_mypy_finds_nothing() -> None:
    if others := unpinned_libraries():
        # A machine with a sourced ROS 2 brings its own numpy, and each numpy has other types.
        pytest.skip(f'types are checked with the pinned libraries only, here: {", ".join(others)}')
    done = run_module('mypy')
    assert done.returncode == 0, done.stdout + done.stderr


def test_package_xml_setup_and_module_name_one_version() -> None:
    package_xml = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert package_xml == setup_keyword('version') == backlash_ros.__version__
