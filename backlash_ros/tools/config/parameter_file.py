"""ROS 2 parameter files: their sections, and which values they hold for an axis."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from backlash_ros.core.parameters import check_names, check_value
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import (
    BRINGUP,
    BY_NAME,
    CONTROLLER,
    NODES,
    Value,
)
from backlash_ros.tools.cli import InputError

ANY = '**'
EVERY_NODE = f'/{ANY}'
AXES = 'axes'


@dataclass(frozen=True)
class Section:
    """Checked values under one name of a file.

    axis: ANY for a wildcard, empty for the node without a namespace. node: ANY for all nodes.
    """

    name: str
    axis: str
    node: str
    values: Mapping[str, Value]

    @property
    def rank(self) -> tuple[bool, bool]:
        """The larger one wins: the name of a node goes before the namespace of an axis."""
        return self.node != ANY, self.axis not in (ANY, '')


@dataclass(frozen=True)
class ParameterFile:
    """A file that was read, its names and values checked."""

    path: Path
    sections: tuple[Section, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes that the file lists; raises InputError for two different lists."""
        listing = [section for section in self.sections if AXES in section.values]
        value = self._merged(listing).get(AXES, ())
        assert isinstance(value, tuple)
        return tuple(map(str, value))

    def check_axes(self, axes: Sequence[str]) -> None:
        """Raise InputError for a section that belongs to none of the axes of the run."""
        for section in self.sections:
            if section.axis in (ANY, *axes) or (section.node == BRINGUP and not section.axis):
                continue
            if section.axis:
                raise InputError(f'{self.path}: section {section.name!r}: '
                                 + no_such_axis(section.axis, axes))
            if axes:
                raise InputError(
                    f'{self.path}: section {section.name!r} belongs to no axis: write '
                    f'/{ANY}/{section.node} for all axes or /{axes[0]}/{section.node} for one'
                )

    def values(self, axis: str) -> dict[str, Value]:
        """Values for an axis by flat name, empty for a run without axes; raises InputError."""
        return self._merged([
            section for section in self.sections
            if section.axis in (ANY, axis) or (section.node == BRINGUP and not section.axis)
        ])

    def _merged(self, sections: Sequence[Section]) -> dict[str, Value]:
        merged: dict[str, Value] = {}
        ranks: dict[str, tuple[bool, bool]] = {}
        for section in sorted(sections, key=lambda section: section.rank, reverse=True):
            for name, value in section.values.items():
                if ranks.setdefault(name, section.rank) != section.rank:
                    continue
                if merged.setdefault(name, value) != value:
                    raise InputError(
                        f'{self.path}: {name} has two values, {merged[name]!r} and {value!r}'
                    )
        return merged


def no_such_axis(axis: str, axes: Sequence[str]) -> str:
    """What is wrong with the name of an axis, and the nearest one that exists."""
    if not axes:
        return f'there is no axis {axis!r}: list it in the parameter {AXES} under /{BRINGUP}'
    near = difflib.get_close_matches(axis, axes, n=1, cutoff=0.0)[0]
    return f'there is no axis {axis!r} among {", ".join(axes)}: did you mean {near}?'


def read_parameter_file(path: Path) -> ParameterFile:
    """Read and check a file.

    Raises InputError for a file that cannot be read, ParameterError for a name or value that
    breaks a rule; both name the file.
    """
    sections = []
    for name, content in _read_yaml(path).items():
        try:
            sections.append(_read_section(str(name), content))
        except (ParameterError, InputError) as error:
            error.args = (f'{path}: {error}',)
            raise
    return ParameterFile(path, tuple(sections))


def _read_section(name: str, content: object) -> Section:
    axis, node = _address(name)
    values = dict(_flatten(_parameters_of(content)))
    check_names(values)
    checked = {key: check_value(BY_NAME[key], value) for key, value in values.items()}
    for key, value in checked.items():
        users = BY_NAME[key].used_by
        if node not in (ANY, *users):
            raise ParameterError(
                key, value, f'is not a parameter of {node}',
                f'put it under {EVERY_NODE} or /{users[0]}',
            )
        if key == AXES and axis not in (ANY, ''):
            raise ParameterError(key, value, 'is for the whole run', f'put it under /{BRINGUP}')
    return Section(name, axis, node, checked)


def _address(name: str) -> tuple[str, str]:
    """Axis and node of the name of a section."""
    parts = name.removeprefix('/').split('/')
    if name == EVERY_NODE:
        return ANY, ANY
    axis, node = ('', parts[0]) if len(parts) == 1 else (parts[0], parts[-1])
    nodes = NODES if axis in ('', ANY) else (*NODES, ANY)
    if len(parts) > 2 or node not in nodes:
        raise InputError(_no_such_section(name, axis))
    return axis, node


def _no_such_section(name: str, axis: str) -> str:
    known = [EVERY_NODE, *(f'/{node}' for node in NODES)]
    if axis:
        near = difflib.get_close_matches(name, [f'/{axis}/{node}' for node in (*NODES, ANY)], n=1)
        cure = f': did you mean {near[0]}?' if near else f', /AXIS/{ANY}, /AXIS/{CONTROLLER} ...'
    else:
        near = difflib.get_close_matches(name, known, n=1)
        cure = f': did you mean {near[0]}?' if near else ''
    return f'section {name!r} is none of {", ".join(known)}{cure}'


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice, of which YAML would keep the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    None, None, f'{key!r} is given twice', node.value[i][0].start_mark
                )
        return super().construct_mapping(node, deep=deep)


def _read_yaml(path: Path) -> dict[object, object]:
    try:
        document = yaml.load(path.read_text(encoding='utf-8'), Loader=_StrictLoader)
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror}') from None
    except UnicodeDecodeError:
        raise InputError(f'{path}: is not a text file in UTF-8') from None
    except yaml.MarkedYAMLError as error:
        line = f' line {error.problem_mark.line + 1}:' if error.problem_mark else ''
        raise InputError(f'{path}:{line} {error.problem}') from None
    except yaml.YAMLError as error:
        raise InputError(f'{path}: is not YAML: {" ".join(str(error).split())}') from None
    if not isinstance(document, dict) or not document:
        raise InputError(f'{path}: must hold "/**: {{ros__parameters: {{...}}}}"')
    return document


def _parameters_of(content: object) -> dict[object, object]:
    if not isinstance(content, dict) or set(content) != {'ros__parameters'}:
        raise InputError('each section must hold ros__parameters and nothing else')
    parameters = content['ros__parameters']
    if not isinstance(parameters, dict):
        raise InputError('ros__parameters must hold "name: value" lines')
    return parameters


def _flatten(tree: Mapping[object, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, dict):
            yield from _flatten(value, f'{name}.')
        else:
            yield name, value
