"""Writes docs/reference/constants.md: every number that is a constant, and its meaning."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

DOCS = Path(__file__).resolve().parents[1]
PACKAGE = DOCS.parent / 'backlash_ros'
# This stands in estimation.md.
ELSEWHERE = PACKAGE / 'core' / 'estimation' / 'settings.py'
CONSTANT = re.compile(r'[A-Z][A-Z0-9_]*')
NUMBERS = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple)
BEGIN = """# Constants

Numbers that are no parameters, as nobody has to choose them: tolerances, deadlines, sizes. Those
that shape the default estimator stand in [estimation.md](../estimation.md#constants). Made from the
code and the comments beside them by `make docs`.
"""


class Constant(NamedTuple):
    """One or several names, their value as it is written, and the comment."""

    names: tuple[str, ...]
    value: str
    meaning: str
    path: Path


def constants_page() -> str:
    """The text of constants.md."""
    parts = [BEGIN]
    for folder, of_folder in groupby(numbers_of_the_package(), key=lambda c: c.path.parent):
        room = folder.relative_to(PACKAGE).as_posix()
        parts.append(f'\n## {"the package" if room == "." else room}\n\n'
                     '| constant | value | meaning | file |\n| --- | --- | --- | --- |\n')
        for found in of_folder:
            names = ', '.join(f'`{name}`' for name in found.names)
            link = f'[{found.path.name}](../../{found.path.relative_to(DOCS.parent).as_posix()})'
            meaning = found.meaning.replace('|', '\\|').replace('*', '\\*')
            parts.append(f'| {names} | `{found.value}` | {meaning} | {link} |\n')
    return ''.join(parts)


def numbers_of_the_package() -> list[Constant]:
    """All of them, those of one folder beside each other."""
    paths = [path for path in PACKAGE.rglob('*.py') if path != ELSEWHERE]
    paths.sort(key=lambda path: (path.parent, path.name))
    return [found for path in paths for found in numbers_of(path)]


def numbers_of(path: Path) -> Iterator[Constant]:
    """The constants of a file that are numbers, or several at once."""
    text = path.read_text()
    lines = text.splitlines()
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign) or not isinstance(node.value, NUMBERS):
            continue
        (target,) = node.targets
        each = target.elts if isinstance(target, ast.Tuple) else [target]
        names = tuple(ast.unparse(name) for name in each)
        leaves = [leaf for leaf in ast.walk(node.value) if isinstance(leaf, ast.Constant)]
        are_numbers = leaves and all(
            isinstance(leaf.value, int | float) and not isinstance(leaf.value, bool)
            for leaf in leaves
        )
        if are_numbers and all(CONSTANT.fullmatch(name) for name in names):
            value = ' '.join((ast.get_source_segment(text, node.value) or '').split())
            yield Constant(names, value, _meaning(lines, node), path)


def _meaning(lines: list[str], node: ast.Assign) -> str:
    """The comment behind a constant, or else the one above it."""
    behind = lines[node.lineno - 1][node.end_col_offset or 0:] \
        if node.lineno == node.end_lineno else ''
    if '#' in behind:
        return behind.partition('#')[2].strip()
    first = node.lineno - 1
    while first > 0 and lines[first - 1].startswith('# ') \
            and not lines[first - 1].startswith('# ---'):
        first -= 1
    return ' '.join(line.removeprefix('# ') for line in lines[first:node.lineno - 1])


def write_constants() -> None:
    """Write the page."""
    (DOCS / 'reference' / 'constants.md').write_text(constants_page(), encoding='utf-8')
