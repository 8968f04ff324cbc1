"""Parameters from YAML files and the command line, and back into a YAML file."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.parameter_table import BY_NAME, PARAMETERS, Value
from backlash_ros.core.parameters import Parameters, check_names, check_value
from backlash_ros.files import write_atomically
from backlash_ros.tools.errors import InputError

PACKAGE = 'backlash_ros'
DEFAULT_CONFIG = 'paper_example.yaml'
EVERY_NODE = '/**'
NODES = ('controller', 'plant', 'reference', 'recorder')
NODE_OF_SECTION = {
    section: node for node in NODES for section in (f'/{node}', node, f'/**/{node}')
}
# A row of a reference file may miss its sample time by this share of the sample period.
TIME_TOLERANCE = 1e-3


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


class _Dumper(yaml.SafeDumper):
    """SafeDumper that writes each list on one line."""


def _on_one_line(dumper: yaml.SafeDumper, values: list[Any]) -> yaml.Node:
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=True)


_Dumper.add_representer(list, _on_one_line)


def load_config(path: Path) -> dict[str, Value]:
    """Return the checked values of a ROS 2 parameter file by flat name.

    Sections of single nodes go before `/**`. Raises InputError for a file that cannot be read,
    ParameterError for a name or value that breaks a rule; both name the file.
    """
    document = _read_yaml(path)
    common: dict[str, Value] = {}
    own: dict[str, Value] = {}
    for section, content in document.items():
        if section != EVERY_NODE and section not in NODE_OF_SECTION:
            raise InputError(
                f'{path}: section {section!r} is none of {EVERY_NODE}, '
                + ', '.join(f'/{node}' for node in NODES)
            )
        try:
            values = dict(_flatten(_parameters_of(content)))
            check_names(values)
            checked = {name: check_value(BY_NAME[name], value) for name, value in values.items()}
            _check_node(section, values)
        except (ParameterError, InputError) as error:
            error.args = (f'{path}: {error}',)
            raise
        target = common if section == EVERY_NODE else own
        for name, value in checked.items():
            if target.setdefault(name, value) != value:
                raise InputError(f'{path}: {name} has two values, {target[name]!r} and {value!r}')
    return {**common, **own}


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


def _check_node(section: object, values: Mapping[str, object]) -> None:
    node = NODE_OF_SECTION.get(str(section))
    for name in values:
        users = BY_NAME[name].used_by
        if node is not None and node not in users:
            raise ParameterError(
                name, values[name], f'is not a parameter of {node}',
                f'put it under {EVERY_NODE} or /{users[0]}',
            )


def parse_setting(text: str) -> tuple[str, Value]:
    """Return name and checked value of `KEY=VALUE`, the value written as in YAML."""
    name, equals, value = text.partition('=')
    name = name.strip()
    if not equals:
        raise InputError(f'--set {text!r} must be KEY=VALUE')
    check_names([name])
    return name, check_value(BY_NAME[name], parse_value(name, value))


def parse_value(name: str, text: str) -> object:
    """Value of a known parameter as it stands on a command line; a word is taken as it is."""
    if isinstance(BY_NAME[name].default, str):
        return text
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ParameterError(name, text, 'is not a value in YAML') from None


def effective_parameters(
    config: Path | None, settings: Sequence[str] = (), seed: int | None = None,
) -> Parameters:
    """Return the complete set: defaults, then the file, then --set, then --seed.

    config: a path, or the name of a shipped file; None for the paper's example.
    """
    values: dict[str, object] = dict(load_config(find_config(config)))
    values.update(parse_setting(setting) for setting in settings)
    if seed is not None:
        values['seed'] = seed
    return Parameters(values)


def find_config(config: Path | None) -> Path:
    """Path of a configuration file: as given, or else among the shipped ones by name."""
    if config is None:
        return shipped_configs() / DEFAULT_CONFIG
    if not config.exists() and config.parent == Path():
        shipped = shipped_configs() / config.name
        if shipped.exists():
            return shipped
    return config


def shipped_configs() -> Path:
    """Folder of the shipped YAML files, wherever this package was installed."""
    # The source tree first: beside the code that runs lies the configuration written for it.
    places = [Path(__file__).resolve().parents[2] / 'config']
    try:
        ament_index = importlib.import_module('ament_index_python.packages')
        places.append(Path(ament_index.get_package_share_directory(PACKAGE)) / 'config')
    except (ImportError, LookupError, OSError):
        pass  # no ament index here, or the package is not in it
    places.append(Path(sys.prefix) / 'share' / PACKAGE / 'config')
    for place in places:
        if (place / DEFAULT_CONFIG).is_file():
            return place
    raise InputError(f'{DEFAULT_CONFIG} is nowhere in {", ".join(map(str, places))}')


def write_config(parameters: Parameters, path: Path) -> None:
    """Write the complete set as a ROS 2 parameter file that every node accepts."""
    tree: dict[str, Any] = {}
    for parameter in PARAMETERS:
        *groups, leaf = parameter.name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        value = parameters[parameter.name]
        branch[leaf] = list(value) if isinstance(value, tuple) else value
    document = {EVERY_NODE: {'ros__parameters': tree}}
    write_atomically(path, yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=1000))
