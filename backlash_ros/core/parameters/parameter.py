"""Declaration of a parameter, and checks of values against it."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from math import inf, isfinite, isinf, isnan, nan
from typing import Any, get_args, get_type_hints

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

UNTOLD = object()  # stands for a value that has nothing to do with the error


class ParameterError(ValueError):
    """A parameter breaks a rule: the message names it, its value, the rule and the cure."""

    def __init__(self, name: str, value: object, rule: str, cure: str = '') -> None:
        self.name = name
        message = f'{name} {rule}' if value is UNTOLD else f'{name}={value!r} {rule}'
        super().__init__(f'{message}: {cure}' if cure else message)


@dataclass(frozen=True)
class Parameter:
    """Declaration of a parameter. elements: types of the elements of a list, ... for any number.

    low, high: inclusive bounds, of each element; above: an exclusive lower bound, nan for none.
    choices: allowed words, each with what it stands for. used_by: executables that read it. change:
    possible 'live' in a running node, in an 'unconfigured' controller, or 'never'. per_node:
    whether a controller with several joints has it only once.
    """

    name: str
    default: Value
    description: str
    elements: tuple[Any, ...]
    unit: str = ''
    low: float = -inf
    high: float = inf
    above: float = nan
    choices: Mapping[str, str] = field(default_factory=dict)
    used_by: tuple[str, ...] = ('controller',)
    change: str = 'unconfigured'
    per_node: bool = False

    @property
    def names(self) -> bool:
        """Whether it is a list of names instead of numbers."""
        return str in self.elements

    @property
    def length(self) -> int | None:
        """Number of elements that a list must have, None for any number."""
        return None if not self.elements or ... in self.elements else len(self.elements)

    @property
    def infinite(self) -> bool:
        """Whether inf is allowed: it means "no limit", or "not known"."""
        return isinstance(self.default, float) and isinf(self.default)

    @property
    def rules(self) -> str:
        """The bounds in words, empty without any."""
        bounds = ('>', self.above), ('>=', self.low), ('<=', self.high)
        return ' and '.join(f'{sign} {bound:g}' for sign, bound in bounds if isfinite(bound))


def option(default: Any, description: str, unit: str = '', choices: Iterable[str] = (),
           **rules: Any) -> Any:
    """Declare a parameter where a group would have its default; rules: fields of Parameter.

    choices: allowed words; 'OLD=NEW' is one that stands for another.
    """
    words = {word: meant or word for word, _, meant in (each.partition('=') for each in choices)}
    return partial(Parameter, default=default, description=description, unit=unit, choices=words,
                   **rules)


_types_in: Any = cache(get_type_hints)


def declared_in(group: type[Any], prefix: str = '') -> Iterator[Parameter]:
    defaults = getattr(group, '_field_defaults', {})
    for name, kind in _types_in(group).items():
        declared = defaults.get(name) or getattr(group, name, None)
        if isinstance(declared, partial):
            yield declared(name=prefix + name, elements=get_args(kind))
        else:
            yield from declared_in(kind, f'{prefix}{name}.')


def attributes_of(group: type[Any], values: Mapping[str, Value],
                  prefix: str = '') -> dict[str, Any]:
    """Return the attributes of a group, from the values of its parameters by name."""
    return {
        name: values[prefix + name] if prefix + name in values
        else kind(**attributes_of(kind, values, f'{prefix}{name}.'))
        for name, kind in _types_in(group).items()
    }


def as_yaml(value: Value) -> str:
    """Format a value for a YAML file, or for -p NAME:=."""
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
    if isinstance(default, tuple):
        return _checked_list(parameter, value)
    if isinstance(default, (bool, str)):
        words = ('true', 'false') if isinstance(default, bool) else tuple(parameter.choices)
        if 'true' in words and isinstance(value, (bool, str)):
            value = str(value).lower()  # YAML and ROS 2 turn true and false into booleans
        if words and value not in words:
            raise refused(value, f'must be one of {", ".join(words)}')
        if not isinstance(value, str):
            raise refused(value, 'must be a string')
        return value == 'true' if isinstance(default, bool) else parameter.choices.get(value, value)
    number = _number(parameter, value)
    if isinstance(default, float):
        return number
    if number != int(number):
        raise refused(value, 'must be a whole number')
    # Beyond 2^53 the detour over a float would lose digits.
    return value if isinstance(value, int) else int(number)


def _checked_list(parameter: Parameter, value: object) -> tuple[float, ...] | tuple[str, ...]:
    refused = partial(ParameterError, parameter.name)
    if isinstance(value, str):
        listed = value.strip('[] ')
        value = [element.strip() for element in listed.split(',')] if listed else []
    if isinstance(value, Mapping) or not isinstance(value, Iterable):
        raise refused(value, f'must be a list of {"names" if parameter.names else "numbers"}')
    elements = list(value)
    if not parameter.names:
        numbers = tuple(_number(parameter, element) for element in elements)
        if len(numbers) != (parameter.length or len(numbers)):
            raise refused(elements, f'must have {parameter.length} numbers')
        if not numbers and parameter.default != ():
            raise refused([], 'must have at least one number')
        return numbers
    namespace = re.compile('[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*')  # as ROS takes it
    for name in elements:
        if not isinstance(name, str) or not namespace.fullmatch(name) or elements.count(name) > 1:
            raise refused(elements, 'must be a list of names', 'each once, of letters, digits and '
                          'single _, a letter first; quote true, on, ...')
    return tuple(elements)


def _number(parameter: Parameter, value: Any) -> float:
    refused = partial(ParameterError, parameter.name)
    try:
        # YAML 1.1 reads 1e-5 (without a point) as a string, and ROS 2 tools send .inf as one.
        number = float(value.replace('.inf', 'inf') if isinstance(value, str) else value)
    except OverflowError:
        raise refused('...', 'is too large for a number') from None
    except (TypeError, ValueError):
        raise refused(value, 'must be a number') from None
    if isinstance(value, bool):
        raise refused(value, 'must be a number')
    if isnan(number) or not (isfinite(number) or parameter.infinite):
        raise refused(number, 'must be finite')
    if isfinite(number) and abs(number) > 1e100:  # so that squares and products stay finite
        raise refused(number, 'must be within ±1e+100', 'choose another unit')
    if number <= parameter.above or not parameter.low <= number <= parameter.high:
        unit = f' [{parameter.unit}]' if parameter.unit else ''
        raise refused(number, f'must be {parameter.rules}{unit}')
    return number
