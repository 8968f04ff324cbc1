"""Parameters of a node: declared from the one table, checked, changed while it runs."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from backlash_ros.core.parameters import Parameters, check_value
from backlash_ros.core.parameters.errors import UNTOLD, ParameterError
from backlash_ros.core.parameters.parameter import Parameter, Value
from backlash_ros.core.parameters.parameter_set import entry_of
from backlash_ros.core.parameters.table import CONTROLLER, NODES, PARAMETERS

# Declared by rclpy itself in every node.
ROS_OWN = {'use_sim_time', 'start_type_description_service'}
PARAMS_FILE = '--params-file'


class ParameterNode(Node):
    """A node with a complete, checked set of parameters."""

    settings: Parameters


def declare_parameters(
    node: Node, executable: str, reconfigurable: bool = False,
) -> Parameters:
    """Declare what the table says this executable uses; return the complete, checked set.

    reconfigurable: whether all but the fixed ones may change while the node is unconfigured.
    Raises ParameterError for what rclpy would ignore (a given name that nobody declares) or refuse.
    """
    # rclpy has no other way to ask for all names that were given.
    given = node.handle.get_parameters(RosParameter)
    parameters = Parameters({
        name: _given_value(parameter) for name, parameter in given.items() if name not in ROS_OWN
    })
    values = {p.name: parameters[p.name] for p in PARAMETERS if executable in p.used_by}
    if executable == CONTROLLER:
        # Of a joint's own parameters those that were given: all of them would be hundreds.
        values |= {
            name: parameters.of_joint(joint)[own] for name in given
            for joint, _, own in [name.partition('.')] if joint in parameters.joint_names
        }
    node.declare_parameters('', [
        (name, _declarable(name, value), ParameterDescriptor()) for name, value in values.items()
    ], ignore_override=True)
    # With one value missing rclpy tells none of those that it is asked for.
    node.set_parameters([_ros_parameter(name, ()) for name, v in values.items() if v == ()])
    for name in values:
        node.set_descriptor(name, describe(_entry(name), name, reconfigurable))
    return parameters


def changed_values(node: Node, requested: Sequence[RosParameter]) -> list[RosParameter]:
    """Those of the requested values that differ from the present ones, in their declared types.

    Command-line tools send 1e-6 as a text and [1, 2] as integers, and load whole files in which
    most values are the present ones. Raises ParameterError, which names the parameter.
    """
    changes = []
    for change in requested:
        present = node.get_parameter(change.name).value if node.has_parameter(change.name) else None
        parameter = entry_of(change.name)
        if parameter is None or present is None:
            if present is None or change.value != present:
                changes.append(change)
            continue
        value = check_value(parameter, _given_value(change))
        if value != check_value(parameter, present):
            changes.append(_ros_parameter(change.name, value))
    return changes


def describe(
    parameter: Parameter, name: str, reconfigurable: bool = False,
) -> ParameterDescriptor:
    """What tools like rqt and `ros2 param describe` show."""
    changes = parameter.live or (reconfigurable and not parameter.fixed)
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        name=name, type=_ros_parameter(name, parameter.default).type_.value,
        description=parameter.description + unit,
        additional_constraints='one of ' + ', '.join(parameter.choices) if parameter.choices
        else parameter.rules,
        read_only=not changes,
    )
    if isfinite(parameter.low) and isfinite(parameter.high):
        if isinstance(parameter.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=parameter.low, to_value=parameter.high, step=0.0)
            ]
        elif isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(
                from_value=int(parameter.low), to_value=int(parameter.high), step=1
            )]
    return descriptor


def let_parameters_change(
    node: ParameterNode, check: Callable[[Parameters], object],
    apply: Callable[[Parameters], None], is_free: Callable[[], bool] = lambda: False,
) -> None:
    """Let parameters change in a running node, all or nothing.

    check: raises ParameterError for a set that the node cannot take up. apply: takes up the new
    settings of the node, given the ones before. is_free: whether those may change as well that are
    not live: the node is unconfigured.
    """
    def changed(changes: list[RosParameter]) -> Parameters:
        return node.settings.replaced(
            {change.name: change.value for change in changes if entry_of(change.name) is not None}
        )

    def on_set(changes: list[RosParameter]) -> SetParametersResult:
        for change in changes:
            entry = entry_of(change.name)
            if entry is not None and not (entry.live or is_free()):
                return SetParametersResult(successful=False, reason=(
                    f'{change.name} is read-only while the node is configured: deactivate it and '
                    'clean it up first'
                ))
        try:
            check(changed(changes))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def post_set(changes: list[RosParameter]) -> None:
        before, node.settings = node.settings, changed(changes)
        apply(before)

    node.add_on_set_parameters_callback(on_set)
    node.add_post_set_parameters_callback(post_set)


def _given_value(parameter: RosParameter) -> object:
    """The value that somebody has given; rcl reads an empty list as no value at all."""
    if parameter.value is not None:
        return parameter.value
    declared = entry_of(parameter.name)
    if declared is not None and (declared.names or declared.default == ()):
        return ()
    raise ParameterError(
        parameter.name, UNTOLD, 'has no value', 'give it one or leave it out'
    )


def _entry(name: str) -> Parameter:
    entry = entry_of(name)
    assert entry is not None
    return entry


def _declarable(name: str, value: Value) -> object:
    """The value, or one in place of an empty list, whose type rclpy could not tell."""
    if value == ():
        return [''] if _entry(name).names else [0.0]
    return list(value) if isinstance(value, tuple) else value


def _ros_parameter(name: str, value: Value) -> RosParameter:
    if value == ():
        kind = RosParameter.Type
        return RosParameter(
            name, kind.STRING_ARRAY if _entry(name).names else kind.DOUBLE_ARRAY, []
        )
    return RosParameter(name, value=_declarable(name, value))


def complaints(arguments: Sequence[str], executable: str, full_name: str) -> list[str]:
    """A sentence for each section of the given files that was probably meant for this node.

    ROS 2 passes over a section whose name is not that of the node, without a word.

    arguments: of the command line. full_name: of the node, with its namespace.
    """
    files = [value for option, value in pairwise(arguments)
             if option == PARAMS_FILE]
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
