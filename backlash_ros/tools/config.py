"""Parameters from ROS 2 parameter files and the command line, and back into such a file.

A section /AXIS/NODE holds values of one node of one axis; ** stands for all axes or all nodes, and
/NODE for the node without a namespace. A named node goes before a named axis.
"""

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core import parameters as catalogue
from backlash_ros.core.parameters import BRINGUP, BY_NAME, ParameterError, Parameters, Value
from backlash_ros.options import find_config
from backlash_ros.tools.cli import InputError

ANY = '**'


class Section(NamedTuple):
    """Checked values of a file; axis: a name, ANY, or '' for a node without a namespace."""

    name: str
    axis: str
    node: str
    values: Mapping[str, Value]

    def is_for(self, *axes: str) -> bool:
        return self.axis in (ANY, *axes) or (self.node == BRINGUP and not self.axis)


class Setting(NamedTuple):
    """One --set: axis is empty for all axes."""

    axis: str
    name: str
    value: Value


class Configuration(NamedTuple):
    """A file with what the command line changes in it; axes of controllers, joints of one."""

    path: Path
    sections: Sequence[Section]
    settings: Sequence[Setting]
    seed: int | None
    axes: tuple[str, ...]
    joints: tuple[str, ...]

    def parameters(self, axis: str = '') -> Parameters:
        """Of a loop, maybe that of a joint: defaults, the file, --set, --seed."""
        if self.joints and axis not in self.joints:
            raise InputError(f'{self.path}: holds the joints {", ".join(self.joints)} of one '
                             f'controller: choose one of them, like --axis {self.joints[0]}')
        return self.of_controller('' if self.joints else axis).of_joint(axis)

    def of_controller(self, axis: str = '') -> Parameters:
        """Return the same for one controller, with what each of its joints has of its own."""
        values: dict[str, object] = dict(self.given(axis))
        for meant in ('', axis):
            values |= {s.name: s.value for s in self.settings if s.axis == meant}
        values |= {f'{s.axis}.{s.name}': s.value for s in self.settings if s.axis in self.joints}
        if self.seed is not None:
            values['seed'] = self.seed
        values.pop('axes', None)
        return Parameters(values)

    def given(self, axis: str = '') -> dict[str, Value]:
        """Values of the file for an axis, by flat name."""
        if self.axes and not axis:
            raise InputError(f'{self.path}: holds the axes {", ".join(self.axes)} and only one can '
                             f'be used here: choose it, like --axis {self.axes[0]}')
        if axis and axis not in self.axes:
            raise InputError(_no_such_axis(axis, self.axes))
        return _merged(self.path, [section for section in self.sections if section.is_for(axis)])


def read_configuration(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None,
) -> Configuration:
    """Read and check everything, as `find_config` finds it; raises InputError, ParameterError."""
    path = find_config(config)
    sections, parsed = _read_sections(path), list(map(parse_setting, settings))
    listed: dict[str, Any] = {
        name: _merged(path, [each for each in sections if name in each.values]).get(name, ())
        for name in ('axes', 'joints')
    }
    listed |= {name: value for _, name, value in parsed if name == 'axes'}
    axes, joints = listed['axes'], listed['joints']
    for axis, name, _ in parsed:
        if axis and axis not in (axes or joints):
            raise InputError(f'--set {axis}/{name}: {_no_such_axis(axis, axes or joints)}')
    for section in sections:
        if not section.is_for(*axes or ('',)):
            rule = f': {_no_such_axis(section.axis, axes)}' if section.axis else (
                f' belongs to no axis: write /{ANY}/{section.node} for all axes or '
                f'/{axes[0]}/{section.node} for one')
            raise InputError(f'{path}: section {section.name!r}{rule}')
    return Configuration(path, sections, parsed, seed, axes, () if axes else joints)


def effective_parameters(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None, axis: str = '',
) -> Parameters:
    """Return the complete set for one axis, as `Configuration.parameters` does."""
    return read_configuration(config, settings, seed).parameters(axis)


def parse_setting(text: str) -> Setting:
    """Return the checked content of `KEY=VALUE` or `AXIS/KEY=VALUE`, the value as in YAML."""
    key, equals, given = text.partition('=')
    axis, slash, name = key.strip().rpartition('/')
    if not equals or (slash and not axis):
        raise InputError(f'--set {text!r} must be KEY=VALUE or AXIS/KEY=VALUE')
    catalogue.check_names([name])
    if axis and name == 'axes':
        raise ParameterError(name, given, 'is for the whole run', 'write --set axes=...')
    try:
        value = given if isinstance(BY_NAME[name].default, str) else yaml.safe_load(given)
    except yaml.YAMLError:
        raise ParameterError(name, given, 'is not a value in YAML') from None
    return Setting(axis, name, catalogue.check_value(BY_NAME[name], value))


def _no_such_axis(axis: str, axes: Sequence[str]) -> str:
    if not axes:
        return f'there is no axis {axis!r}: list it in the parameter axes under /{BRINGUP}'
    near = difflib.get_close_matches(axis, axes, n=1, cutoff=0.0)[0]
    return f'there is no axis {axis!r} among {", ".join(axes)}: did you mean {near}?'


def _merged(path: Path, sections: Sequence[Section]) -> dict[str, Value]:
    """The values of sections, of each name those of the most specific; raises InputError."""
    merged: dict[str, tuple[tuple[bool, bool], Value]] = {}
    for rank, section in sorted((((s.node != ANY, s.axis not in (ANY, '')), s) for s in sections),
                                key=lambda each: each[0]):
        for name, value in section.values.items():
            known, other = merged.get(name, (rank, value))
            if known == rank and other != value:
                raise InputError(f'{path}: {name} has two values, {other!r} and {value!r}')
            merged[name] = rank, value
    return {name: value for name, (_, value) in merged.items()}


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key given twice, of which YAML would keep the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise yaml.constructor.ConstructorError(
                    None, None, f'{key!r} is given twice', node.value[i][0].start_mark)
        return super().construct_mapping(node, deep=deep)


def _read_sections(path: Path) -> list[Section]:
    try:
        document = yaml.load(path.read_text(encoding='utf-8'), Loader=_StrictLoader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = error.strerror if isinstance(error, OSError) else ' '.join(str(error).split())
        raise InputError(f'{path}: cannot be read: {reason}') from None
    try:
        sections = {}
        for name, content in document.items() if isinstance(document, dict) else ():
            if isinstance(content, dict) and [*content] == ['ros__parameters'] \
                    and isinstance(content['ros__parameters'], dict):
                sections[str(name)] = dict(flattened(content['ros__parameters']))
        if not sections or len(sections) < len(document):
            raise InputError('must hold sections "NAME: {ros__parameters: {name: value, ...}}"')
        # What is wrong with the values of a joint, all values together tell.
        joints = [joint for values in sections.values()
                  for joint in Parameters({'joints': values.get('joints', ())}).joints]
        return [_checked(name, values, joints) for name, values in sections.items()]
    except (ParameterError, InputError) as error:
        error.args = (f'{path}: {error}',)
        raise


def flattened(tree: Mapping[object, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    """Names, with points in them, and values of nested sections."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flattened(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


def _checked(name: str, values: Mapping[str, object], joints: Sequence[str]) -> Section:
    axis, _, node = name.removeprefix('/').rpartition('/')
    if name == f'/{ANY}':
        axis = ANY
    elif '/' in axis or not (node in catalogue.NODES or (node == ANY and axis not in ('', ANY))):
        known = [f'/{ANY}', *(f'/{each}' for each in catalogue.NODES)]
        similar = [*known, *(f'/{axis}/{each}' for each in (*catalogue.NODES, ANY))]
        near = difflib.get_close_matches(name, similar, n=1)
        raise InputError(f'section {name!r} is none of {", ".join(known)}, /AXIS/{ANY}, '
                         '/AXIS/controller ...' + ''.join(f': did you mean {n}?' for n in near))
    Parameters({'joints': joints, **values})  # checks all names and values
    checked = {}
    for key, value in values.items():
        entry = catalogue.entry_of(key)
        assert entry is not None
        checked[key] = catalogue.check_value(entry, value)
        if node not in (ANY, *entry.used_by):
            raise ParameterError(key, checked[key], f'is not a parameter of {node}',
                                 f'put it under /{ANY} or /{entry.used_by[0]}')
        if key == 'axes' and axis not in (ANY, ''):
            raise ParameterError(key, value, 'is for the whole run', f'put it under /{BRINGUP}')
    return Section(name, axis, node, checked)


class _Dumper(yaml.SafeDumper):
    """Writes each list on one line."""


_Dumper.add_representer(list, lambda dumper, values: dumper.represent_sequence(
    'tag:yaml.org,2002:seq', values, flow_style=True))


def write_config(parameters: Parameters, path: Path) -> None:
    """Write the complete set as a ROS 2 parameter file that every node accepts."""
    write_atomically(path, config_text(parameters))


def config_text(parameters: Parameters) -> str:
    """Content of that file, without empty lists, which ROS 2 does not have."""
    common = [p for p in BY_NAME.values() if p.used_by != (BRINGUP,) and parameters[p.name] != ()]
    own = [p.name for p in BY_NAME.values()
           if p not in common and parameters[p.name] != p.default]
    of_all = _tree(parameters, (p.name for p in common))
    for joint in parameters.joints:
        of_joint = parameters.of_joint(joint)
        of_all[joint] = _tree(of_joint, (
            p.name for p in common if catalogue.CONTROLLER in p.used_by and not p.per_node
            and of_joint[p.name] != parameters[p.name]))
    document = {f'/{ANY}': {'ros__parameters': of_all}}
    if own:
        document[f'/{BRINGUP}'] = {'ros__parameters': _tree(parameters, own)}
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=1000)


def _tree(parameters: Parameters, names: Iterable[str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name in names:
        *groups, leaf = name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        value = parameters[name]
        branch[leaf] = list(value) if isinstance(value, tuple) else value
    return tree
