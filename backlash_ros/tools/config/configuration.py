"""Parameters from YAML files and the command line, and back into a YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from backlash_ros import shipped
from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.parameters import Parameters, check_names, check_value
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import BRINGUP, BY_NAME, PARAMETERS, Parameter, Value
from backlash_ros.shipped import DEFAULT_CONFIG
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.config.parameter_file import (
    AXES,
    EVERY_NODE,
    ParameterFile,
    no_such_axis,
    read_parameter_file,
)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that writes each list on one line."""


def _on_one_line(dumper: yaml.SafeDumper, values: list[Any]) -> yaml.Node:
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=True)


_Dumper.add_representer(list, _on_one_line)


@dataclass(frozen=True)
class Setting:
    """One --set: axis is empty for all axes."""

    axis: str
    name: str
    value: Value


@dataclass(frozen=True)
class Configuration:
    """A file with what the command line changes in it; axes: empty for a run without axes."""

    file: ParameterFile
    settings: tuple[Setting, ...]
    seed: int | None
    axes: tuple[str, ...]

    def parameters(self, axis: str = '') -> Parameters:
        """Return the complete set: defaults, then the file, then --set, then --seed.

        axis: one of the axes, empty only if there are none; raises InputError.
        """
        if self.axes and not axis:
            raise InputError(
                f'{self.file.path}: holds the axes {", ".join(self.axes)} and only one can be '
                f'used here: choose it, like --axis {self.axes[0]}'
            )
        if axis and axis not in self.axes:
            raise InputError(no_such_axis(axis, self.axes))
        values: dict[str, object] = dict(self.file.values(axis))
        for meant in ('', axis):
            values.update({s.name: s.value for s in self.settings if s.axis == meant})
        if self.seed is not None:
            values['seed'] = self.seed
        values.pop(AXES, None)
        return Parameters(values)


def read_configuration(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None,
) -> Configuration:
    """Read and check everything; raises InputError and ParameterError.

    config: a path, or the name of a shipped file; None for the paper's example.
    """
    file = read_parameter_file(find_config(config))
    parsed = tuple(parse_setting(setting) for setting in settings)
    axes = file.axes
    for setting in parsed:
        if setting.name == AXES:
            axes = Parameters({AXES: setting.value}).get_strs(AXES)
    for setting in parsed:
        if setting.axis and setting.axis not in axes:
            raise InputError(f'--set {setting.axis}/{setting.name}: '
                             + no_such_axis(setting.axis, axes))
    file.check_axes(axes)
    return Configuration(file, parsed, seed, axes)


def effective_parameters(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None, axis: str = '',
) -> Parameters:
    """Return the complete set for one axis, as `Configuration.parameters` does."""
    return read_configuration(config, settings, seed).parameters(axis)


def load_config(path: Path) -> dict[str, Value]:
    """Return the values that a file without axes holds, by flat name.

    Raises InputError and ParameterError.
    """
    file = read_parameter_file(path)
    file.check_axes(())
    return file.values('')


def parse_setting(text: str) -> Setting:
    """Return the checked content of `KEY=VALUE` or `AXIS/KEY=VALUE`, the value as in YAML."""
    key, equals, value = text.partition('=')
    axis, slash, name = key.strip().rpartition('/')
    if not equals or (slash and not axis):
        raise InputError(f'--set {text!r} must be KEY=VALUE or AXIS/KEY=VALUE')
    check_names([name])
    if axis and name == AXES:
        raise ParameterError(name, value, 'is for the whole run', f'write --set {AXES}=...')
    return Setting(axis, name, check_value(BY_NAME[name], parse_value(name, value)))


def parse_value(name: str, text: str) -> object:
    """Value of a known parameter as it stands on a command line; a word is taken as it is."""
    if isinstance(BY_NAME[name].default, str):
        return text
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ParameterError(name, text, 'is not a value in YAML') from None


def find_config(config: Path | None) -> Path:
    """Path of a configuration file: as given, or else among the shipped ones by name."""
    return shipped_configs() / DEFAULT_CONFIG if config is None else shipped.find_config(config)


def shipped_configs() -> Path:
    """Folder of the shipped YAML files; raises InputError."""
    places = shipped.config_folders()
    for place in places:
        if (place / DEFAULT_CONFIG).is_file():
            return place
    raise InputError(f'{DEFAULT_CONFIG} is nowhere in {", ".join(map(str, places))}')


def write_config(parameters: Parameters, path: Path) -> None:
    """Write the complete set as a ROS 2 parameter file that every node accepts.

    What is of bringup alone stands in a section of its own, and only if it is given. Empty lists,
    which ROS 2 does not have, are left out.
    """
    common = [p for p in PARAMETERS if p.used_by != (BRINGUP,) and parameters[p.name] != ()]
    own = [p for p in PARAMETERS if p not in common and parameters[p.name] != p.default]
    document = {EVERY_NODE: {'ros__parameters': _tree(parameters, common)}}
    if own:
        document[f'/{BRINGUP}'] = {'ros__parameters': _tree(parameters, own)}
    write_atomically(path, yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=1000))


def yaml_value(value: Value) -> str:
    """A value as one line of YAML that every reader takes for the same type."""
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.dump(plain, Dumper=_Dumper, width=10000).removesuffix('...\n').strip()


def _tree(parameters: Parameters, written: Sequence[Parameter]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for parameter in written:
        *groups, leaf = parameter.name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        value = parameters[parameter.name]
        branch[leaf] = list(value) if isinstance(value, tuple) else value
    return tree
