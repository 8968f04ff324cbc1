"""Constants of modules: a name means one thing in the whole package."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from places import ROOT


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
