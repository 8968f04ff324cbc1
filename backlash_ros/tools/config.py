"""Read parameters from ROS 2 parameter files and the command line, and write such files.

A section /AXIS/NODE holds values of one node of one axis; ** stands for all axes or all nodes, and
/NODE for the node without a namespace. A named node takes precedence over a named axis.
"""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.parameters import (
    BRINGUP,
    BY_NAME,
    CONTROLLER,
    NODES,
    ParameterError,
    Parameters,
    Value,
    check_names,
    check_value,
    entry_of,
)
from backlash_ros.options import find_config
from backlash_ros.tools.cli import InputError

ANY = '**'


class Configuration(NamedTuple):
    """A parameter file with changes by the command line; its axes, or joints of the only one.

    sections: checked values by section and name. settings: (axis or '' for all, name, value) each.
    """

    path: Path
    sections: Mapping[str, Mapping[str, Value]]
    settings: Sequence[tuple[str, str, Value]]
    seed: int | None
    axes: tuple[str, ...]
    joints: tuple[str, ...]

    def parameters(self, axis: str = '') -> Parameters:
        """Parameters of one loop, of an axis or a joint: defaults, the file, --set, --seed."""
        if self.joints:
            _check_axis(self.path, axis, self.joints)
        return self.of_controller('' if self.joints else axis).of_joint(axis)

    def of_controller(self, axis: str = '') -> Parameters:
        """The same for one controller, with the own parameters of each of its joints."""
        values: dict[str, object] = {**self.given(axis)}
        for meant, name, value in sorted(self.settings, key=lambda setting: setting[0] != ''):
            if meant in ('', axis):
                values[name] = value
            elif meant in self.joints:
                values[f'{meant}.{name}'] = value
        if self.seed is not None:
            values['seed'] = self.seed
        values.pop('axes', None)
        return Parameters(values)

    def given(self, axis: str = '') -> dict[str, Value]:
        """Values of the file for an axis, by flat name."""
        _check_axis(self.path, axis, self.axes)
        values: dict[str, Value] = {}
        for equals in _sections_for(axis):
            found: dict[str, Value] = {}
            for section in equals:
                for name, value in self.sections.get(section, {}).items():
                    if found.setdefault(name, value) != value:
                        raise InputError(f'{self.path}: {name} has two values, {found[name]!r} '
                                         f'and {value!r}')
            values |= found
        return values


def _sections_for(axis: str) -> tuple[list[str], ...]:
    """Names of the sections for an axis, '' for a loop without one, the most specific ones last."""
    own = f'/{axis}' if axis else ''
    return ([f'/{ANY}'], [f'{own}/{ANY}'], [f'/{ANY}/{node}' for node in NODES],
            [f'/{BRINGUP}', *(f'{own}/{node}' for node in NODES)])


def read_configuration(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None,
) -> Configuration:
    """Read the file that `find_config` finds and check all; raises InputError, ParameterError."""
    path, parsed = find_config(config), list(map(parse_setting, settings))
    sections = _read_sections(path)
    try:
        listed: dict[str, Any] = {
            name: check_value(BY_NAME[name], values[name])
            for values in sections.values() for name in ('axes', 'joints') if name in values}
        listed |= {name: value for _, name, value in parsed if name == 'axes'}
        axes, joints = listed.get('axes', ()), listed.get('joints', ())
        known = [name for axis in axes or ('',) for names in _sections_for(axis) for name in names]
        for section, values in sections.items():
            if section not in known:
                where = f'the axes {", ".join(axes)}' if axes else \
                    f'a run without the parameter axes, under /{BRINGUP}'
                near = difflib.get_close_matches(section, known, n=1, cutoff=0.0)[0]
                raise InputError(
                    f'section {section!r} is for no node of {where}: did you mean {near}?')
            Parameters({'joints': joints, **values})  # checks all names and values
        checked = {section: {
            name: check_value(entry_of(name) or BY_NAME[name], value)
            for name, value in values.items()} for section, values in sections.items()}
    except (ParameterError, InputError) as error:
        error.args = (f'{path}: {error}',)
        raise
    for axis, name, _ in parsed:
        if axis:
            _check_axis(f'--set {axis}/{name}', axis, axes or joints)
    return Configuration(path, checked, parsed, seed, axes, () if axes else joints)


def parse_setting(text: str) -> tuple[str, str, Value]:
    """Parse `KEY=VALUE` or `AXIS/KEY=VALUE`, VALUE in YAML; returns axis, name, checked value."""
    key, equals, given = text.partition('=')
    axis, slash, name = key.strip().rpartition('/')
    if not (equals and name) or (slash and not axis):
        raise InputError(f'--set {text!r} must be KEY=VALUE or AXIS/KEY=VALUE')
    check_names([name])
    try:
        value = given if isinstance(BY_NAME[name].default, str) else yaml.safe_load(given)
    except (yaml.YAMLError, ValueError):  # the latter for a date that does not exist
        raise ParameterError(name, given, 'is not a value in YAML') from None
    return axis, name, check_value(BY_NAME[name], value)


def _check_axis(where: object, axis: str, known: Sequence[str]) -> None:
    if axis not in (known or ('',)):
        rule = f'be one of {", ".join(known)}: choose it with --axis' if known else \
            f'stand in the parameter axes, under /{BRINGUP}'
        raise InputError(f'{where}: axis={axis!r} must {rule}')


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that is given twice; YAML would keep the last value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    None, None, f'{key!r} is given twice', node.value[i][0].start_mark)
        return super().construct_mapping(node, deep=deep)


def _read_sections(path: Path) -> dict[str, dict[str, object]]:
    """Values by section, whose name begins with /, and by flat name."""
    try:
        document = yaml.load(path.read_text(encoding='utf-8'), Loader=_StrictLoader)
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = error.strerror if isinstance(error, OSError) else ' '.join(str(error).split())
        raise InputError(f'{path}: cannot be read: {reason}') from None
    sections = {}
    for name, content in document.items() if isinstance(document, dict) else ():
        values = content.get('ros__parameters') if isinstance(content, dict) else None
        if isinstance(values, dict) and len(content) == 1:
            sections[f'/{str(name).removeprefix("/")}'] = dict(flattened(values))
    if not sections or len(sections) < len(document):
        raise InputError(f'{path}: must hold sections "NAME: {{ros__parameters: {{name: value, '
                         '...}}", each once')
    return sections


def flattened(tree: Mapping[object, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    """Flat names, with dots, and values of a nested mapping."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flattened(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


class _Dumper(yaml.SafeDumper):
    """Writes each list on one line."""


_Dumper.add_representer(list, lambda dumper, values: dumper.represent_sequence(
    'tag:yaml.org,2002:seq', values, flow_style=True))


def write_config(parameters: Parameters, path: Path) -> None:
    """Write all parameters to a ROS 2 parameter file that every node accepts."""
    write_atomically(path, config_text(parameters))


def config_text(parameters: Parameters) -> str:
    """The text of such a file, without empty lists, which ROS 2 does not allow."""
    common = [p for p in BY_NAME.values() if parameters[p.name] != ()
              and (p.used_by != (BRINGUP,) or parameters[p.name] != p.default)]
    values = {p.name: parameters[p.name] for p in common}
    for joint in parameters.joints:
        own = parameters.of_joint(joint)
        values |= {f'{joint}.{p.name}': own[p.name] for p in common if CONTROLLER in p.used_by
                   and not p.per_node and own[p.name] != parameters[p.name]}
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *groups, leaf = name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        branch[leaf] = list(value) if isinstance(value, tuple) else value
    return yaml.dump({f'/{ANY}': {'ros__parameters': tree}}, Dumper=_Dumper, sort_keys=False,
                     width=1000)
