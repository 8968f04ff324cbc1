"""Sections of parameter files that were meant for a node but do not reach it.

ROS 2 passes over a section whose name is not that of the node, without a word.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from backlash_ros.core.parameters.table import NODES

OPTION = '--params-file'


def complaints(arguments: Sequence[str], executable: str, full_name: str) -> list[str]:
    """A sentence for each section of the given files that was probably meant for this node.

    arguments: of the command line. full_name: of the node, with its namespace.
    """
    files = [value for option, value in pairwise(arguments)
             if option == OPTION]
    found = []
    for file in files:
        sections = list(_section_names(_content(file)))
        found += [
            f'{file}: section {name} is not for {full_name}, its values are not used: '
            f'write {cure}' for name, cure in unused(sections, executable, full_name)
        ]
    return found


def unused(
    sections: Sequence[str], executable: str, full_name: str,
) -> Iterator[tuple[str, str]]:
    """Sections that do not reach the node though they seem to be meant for it, and what would.

    A section of the node's name in another namespace is none of its business where the file has
    one for its own namespace too, or where both have a namespace: it may be that of another axis.
    """
    *namespace, own = full_name.strip('/').split('/')
    meant = [name for name in sections if _last(name) in (own, executable)]
    reached = any(_reaches(name, full_name) for name in meant)
    for name in sections:
        last = _last(name)
        if name in meant and not reached:
            inside = len(name.strip('/').split('/')) > 1
            if not (inside and namespace) or last != own:
                yield name, f'/**/{own}'
        elif last not in NODES and '*' not in last:
            # A misspelt name rather than somebody else's node.
            near = difflib.get_close_matches(last, [executable], n=1, cutoff=0.8)
            if near:
                yield name, f'/**/{own}'


def _last(section: str) -> str:
    return section.strip('/').split('/')[-1]


def _reaches(section: str, full_name: str) -> bool:
    """Whether ROS 2 gives the node the values of a section; ** stands for any namespaces."""
    parts = ['(/[^/]+)*' if part == '**' else '/[^/]+' if part == '*' else '/' + re.escape(part)
             for part in section.strip('/').split('/')]
    return re.fullmatch(''.join(parts), full_name) is not None


def _section_names(content: Mapping[Any, Any], prefix: str = '') -> Iterator[str]:
    for key, value in content.items():
        name = f'{prefix}/{str(key).strip("/")}'
        if not isinstance(value, Mapping):
            continue
        if 'ros__parameters' in value:
            yield name
        else:
            yield from _section_names(value, name)


def _content(file: str) -> Mapping[Any, Any]:
    import yaml  # most nodes start without a file

    # ROS 2 itself has refused what cannot be read.
    content = yaml.safe_load(Path(file).read_text(encoding='utf-8'))
    return content if isinstance(content, Mapping) else {}
