"""What is declared of a parameter, and the check of a value against it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from math import inf, isfinite, isinf, isnan
from typing import Any, TypeVar, get_args, get_type_hints

from backlash_ros.core.parameters.errors import ParameterError

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
Group = TypeVar('Group')


@dataclass(frozen=True)
class Parameter:
    """A parameter: its default gives its type, low and high hold for each element of a list.

    above: low itself is excluded. choices: the allowed words. aliases: former words among them,
    each with the one that it stands for. used_by: executables that read it. live: may change in a
    running node. fixed: may not even change in a controller that is unconfigured. per_node: a
    controller with several joints has it once. length: how many elements a list must have, None
    for any. names: a list of names instead of numbers.
    """

    name: str
    default: Value
    description: str
    unit: str = ''
    low: float = -inf
    high: float = inf
    above: bool = False
    choices: tuple[str, ...] = ()
    aliases: tuple[tuple[str, str], ...] = ()
    used_by: tuple[str, ...] = ('controller',)
    live: bool = False
    fixed: bool = False
    per_node: bool = False
    length: int | None = None
    names: bool = False

    @property
    def infinite(self) -> bool:
        """Whether inf is allowed: it means "no limit", or "not known"."""
        return isinstance(self.default, float) and isinf(self.default)

    @property
    def rules(self) -> str:
        """The bounds in words, empty without any."""
        sign = '>' if self.above else '>='
        return ' and '.join(
            ([f'{sign} {self.low:g}'] if isfinite(self.low) else [])
            + ([f'<= {self.high:g}'] if isfinite(self.high) else [])
        )


def option(default: Any, description: str, unit: str = '', **rules: Any) -> Any:
    """The field of a group that declares a parameter. rules: fields of Parameter."""
    declare = partial(Parameter, default=default, description=description, unit=unit, **rules)
    return field(default=default, metadata={'declare': declare})


def declared_in(group: type[Any], prefix: str = '') -> Iterator[Parameter]:
    """The parameters of a group and of the groups in it; lists are described by their type."""
    types = get_type_hints(group)
    for each in fields(group):
        name = prefix + each.name
        if 'declare' in each.metadata:
            elements = get_args(types[each.name])
            yield each.metadata['declare'](
                name=name, names=str in elements,
                length=len(elements) if elements and ... not in elements else None,
            )
        else:
            yield from declared_in(types[each.name], f'{name}.')


def filled(group: type[Group], values: Mapping[str, Value], prefix: str = '') -> Group:
    """A group with the values of its parameters, given by their names."""
    untyped: Any = group
    return group(**{
        each.name: values[prefix + each.name] if 'declare' in each.metadata
        else filled(type(each.default), values, f'{prefix}{each.name}.')
        for each in fields(untyped)
    })


def as_yaml(value: Value) -> str:
    """A value as it stands in a YAML file or after -p NAME:=."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return '[' + ', '.join(map(as_yaml, value)) + ']'
    if isinstance(value, str):
        return value or "''"
    if abs(value) == inf:
        return '.inf' if value > 0 else '-.inf'
    return f'{value:g}' if isinstance(value, float) and value == float(f'{value:g}') else str(value)


def check_value(parameter: Parameter, value: object) -> Value:
    """Return value in the type of the parameter; raises ParameterError."""
    default, refused = parameter.default, partial(ParameterError, parameter.name)
    if isinstance(default, bool):
        if not isinstance(value, (bool, str)) or str(value).lower() not in ('true', 'false'):
            raise refused(value, 'must be true or false')
        return str(value).lower() == 'true'
    if isinstance(default, str):
        if 'true' in parameter.choices and isinstance(value, (bool, str)):
            value = str(value).lower()  # YAML and ROS 2 take true and false for more than words
        if not isinstance(value, str):
            raise refused(value, 'must be a text')
        if parameter.choices and value not in parameter.choices:
            raise refused(value, 'must be one of ' + ', '.join(parameter.choices))
        return dict(parameter.aliases).get(value, value)
    if isinstance(default, tuple):
        return list_of_names(parameter, value) if parameter.names else _numbers(parameter, value)
    number = _number(parameter, value)
    if isinstance(default, float):
        return number
    if number != int(number):
        raise refused(value, 'must be a whole number')
    # Beyond 2^53 the detour over a float would lose digits.
    return value if isinstance(value, int) else int(number)


def _elements(parameter: Parameter, value: object, kind: str) -> list[object]:
    if isinstance(value, str):
        listed = value.strip('[] ')
        value = [element.strip() for element in listed.split(',')] if listed else []
    if isinstance(value, Mapping) or not isinstance(value, Iterable):
        raise ParameterError(parameter.name, value, f'must be a list of {kind}')
    return list(value)


def list_of_names(parameter: Parameter, value: object) -> tuple[str, ...]:
    """Return a list of names, each once; raises ParameterError."""
    names = _elements(parameter, value, 'names')
    namespace = re.compile('[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*')  # as ROS takes it
    for name in names:
        if not isinstance(name, str) or not namespace.fullmatch(name) or names.count(name) > 1:
            raise ParameterError(
                parameter.name, names, 'must be a list of names',
                'each once, of letters, digits and single _, a letter first; quote true, on, ...',
            )
    return tuple(map(str, names))


def _numbers(parameter: Parameter, value: object) -> tuple[float, ...]:
    elements = _elements(parameter, value, 'numbers')
    numbers = tuple(_number(parameter, element) for element in elements)
    if len(numbers) != (parameter.length or len(numbers)):
        raise ParameterError(parameter.name, elements, f'must have {parameter.length} numbers')
    if not numbers and parameter.default != ():
        raise ParameterError(parameter.name, [], 'must have at least one number')
    return numbers


def _number(parameter: Parameter, value: Any) -> float:
    refused = partial(ParameterError, parameter.name)
    try:
        # YAML 1.1 reads 1e-5 (no point, no sign) as a text, and tools of ROS 2 send .inf as one.
        number = float(value.replace('.inf', 'inf') if isinstance(value, str) else value)
    except OverflowError:
        raise refused('...', 'is too large for a number') from None
    except (TypeError, ValueError):
        number = None
    if number is None or isinstance(value, bool):
        raise refused(value, 'must be a number')
    if isnan(number) or not (isfinite(number) or parameter.infinite):
        raise refused(number, 'must be finite')
    if isfinite(number) and abs(number) > 1e100:  # squares, and products of two, still are numbers
        raise refused(number, 'must be within ±1e+100', 'choose another unit')
    excluded = parameter.above and number == parameter.low
    if excluded or not parameter.low <= number <= parameter.high:
        unit = f' [{parameter.unit}]' if parameter.unit else ''
        raise refused(number, f'must be {parameter.rules}{unit}')
    return number
