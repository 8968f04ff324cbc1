"""Parameters of a node: declared from the one table, checked, changed while it runs."""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from backlash_ros.core.parameters import (
    BY_NAME,
    CONTROLLER,
    UNTOLD,
    Parameter,
    ParameterError,
    Parameters,
    Value,
    check_value,
    entry_of,
)


class ParameterNode(Node):
    """A node with a complete, checked set of parameters, of which all or none change."""

    settings: Parameters
    reconfigurable = False  # whether all but the fixed ones may change while it is unconfigured
    configured = False  # whether only live ones may change now, of those that are not read-only

    def check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the node cannot take up."""

    def take_up(self, before: Parameters) -> None:
        """Use the settings, which have changed."""

    def declare_settings(self, executable: str) -> None:
        """Declare what the table says of this executable; raises ParameterError."""
        # rclpy has no other way to ask for all names that were given; two are declared by itself.
        given = {
            name: _given_value(parameter)
            for name, parameter in self.handle.get_parameters(RosParameter).items()
            if name not in ('use_sim_time', 'start_type_description_service')
        }
        self.settings = parameters = Parameters(given)
        values = {p.name: parameters[p.name] for p in BY_NAME.values() if executable in p.used_by}
        if executable == CONTROLLER:
            # Of a joint's own parameters those that were given: all of them would be hundreds.
            values |= {
                name: parameters.of_joint(joint)[own] for name in given
                for joint, _, own in [name.partition('.')] if joint in parameters.joint_names
            }
        for name, value in values.items():
            entry = entry_of(name)
            assert entry is not None
            present = _ros_parameter(name, value, entry)
            # The type of an empty list is declared by another one, and with a value missing rclpy
            # would tell none of those that it is asked for.
            of_the_type = [''] if entry.names else [0.0]
            self.declare_parameter(
                name, of_the_type if value == () else present.value, ignore_override=True
            )
            if value == ():
                self.set_parameters([present])
            self.set_descriptor(name, ParameterDescriptor(
                name=name, type=_ros_parameter(name, entry.default, entry).type_.value,
                description=entry.description + (f' [{entry.unit}]' if entry.unit else ''),
                additional_constraints='one of ' + ', '.join(entry.choices) if entry.choices
                else entry.rules,
                read_only=entry.change not in ('live', *['unconfigured'] * self.reconfigurable),
            ))

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set what differs from the present values, in the declared types.

        Command-line tools send 1e-6 as a text, and load whole files of mostly present values.
        """
        changes, values = [], {}
        try:
            for change in parameter_list:
                name, entry = change.name, entry_of(change.name)
                present = self.get_parameter_or(name).value
                if entry is None or present is None:
                    changes += [change] * (present is None or change.value != present)
                elif (value := check_value(entry, _given_value(change))) \
                        != check_value(entry, present):
                    if entry.change == 'unconfigured' and self.configured:
                        raise ParameterError(
                            name, UNTOLD, 'is read-only while the node is configured',
                            'deactivate it and clean it up first',
                        )
                    changes.append(_ros_parameter(name, value, entry))
                    values[name] = value
            if not changes:
                return SetParametersResult(successful=True)
            settings = self.settings.replaced(values)
            self.check_change(settings)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(changes)
        if result.successful:
            before, self.settings = self.settings, settings
            self.take_up(before)
        return result


def _given_value(parameter: RosParameter) -> object:
    if parameter.value is not None:
        return parameter.value
    entry = entry_of(parameter.name)
    if entry is not None and (entry.names or entry.default == ()):
        return ()
    raise ParameterError(parameter.name, UNTOLD, 'has no value', 'give it one or leave it out')


def _ros_parameter(name: str, value: Value, entry: Parameter) -> RosParameter:
    if value == ():
        kind = RosParameter.Type
        return RosParameter(name, kind.STRING_ARRAY if entry.names else kind.DOUBLE_ARRAY, [])
    return RosParameter(name, value=list(value) if isinstance(value, tuple) else value)


def complaints(arguments: Sequence[str], executable: str, full_name: str) -> Iterator[str]:
    """What to do for each section of given files that ROS 2 passes over without a word."""
    for option, file in pairwise(arguments):
        if option == '--params-file':
            import yaml  # most nodes start without a file

            # ROS 2 itself has refused what cannot be read.
            content = yaml.safe_load(Path(file).read_text(encoding='utf-8'))
            for name in unused(list(_section_names(content)), executable, full_name):
                yield f'{file}: section {name} is not for {full_name}, its values are not used: ' \
                    f'write /**/{full_name.rpartition("/")[2]}'


def unused(sections: Sequence[str], executable: str, full_name: str) -> list[str]:
    """Sections that do not reach the node though they seem to be meant for it.

    None where another one of its name does. A section with a namespace may be another axis.
    """
    *namespace, own = full_name.strip('/').split('/')
    meant = []
    for section in sections:
        *above, last = section.strip('/').split('/')
        if last == own or difflib.get_close_matches(last, [executable], cutoff=0.8):
            # ** stands for any namespaces.
            pattern = re.escape(f'/{section.strip("/")}').replace(r'/\*\*', '(/[^/]+)*')
            if re.fullmatch(pattern.replace(r'/\*', '/[^/]+'), full_name):
                return []
            if not (namespace and above):
                meant.append(section)
    return meant


def _section_names(content: Any, prefix: str = '') -> Iterator[str]:
    for key, value in content.items() if isinstance(content, Mapping) else ():
        name = f'{prefix}/{str(key).strip("/")}'
        if isinstance(value, Mapping) and 'ros__parameters' in value:
            yield name
        else:
            yield from _section_names(value, name)
