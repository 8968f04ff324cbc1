"""Check of parameter values against the table, wherever they come from."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from math import hypot, isfinite, isinf, isnan, sqrt
from typing import cast

from backlash_ros.core.parameters.errors import UNTOLD, ParameterError
from backlash_ros.core.parameters.joints import check_joints, split, values_of
from backlash_ros.core.parameters.table import BY_NAME, JOINTS, PARAMETERS, Parameter, Value

NOISE = 'estimator.output_noise_std'
LARGEST = 1e100  # squares, and products of two, still are numbers
LIMITS = ('control.min', 'control.max', 'control.rate_max')
NAME = re.compile(r'[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*')  # a namespace of ROS


class Parameters(Mapping[str, Value]):
    """A complete, checked set of parameter values, by name."""

    def __init__(self, values: Mapping[str, object] | None = None) -> None:
        """Take given values and the defaults of all others; raises ParameterError."""
        self._given = dict(values or {})
        joints = _names(BY_NAME[JOINTS], self._given.get(JOINTS, ()))
        given, own = split(self._given, joints)
        check_joints(joints)
        check_names(given, joints)
        self._values = {
            p.name: check_value(p, given[p.name]) if p.name in given else p.default
            for p in PARAMETERS
        }
        if NOISE not in given:
            # Whoever simulates noise means the estimator to know it, unless told otherwise.
            simulated = hypot(
                self.get_float('output_noise_std'), self.get_float('output_quantum') / sqrt(12.0)
            )
            self._values[NOISE] = max(self.get_float(NOISE), simulated)
        self._of_joints = {joint: _of_joint(joint, given, own[joint]) for joint in joints}

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints; a single one without `joints` is nameless."""
        return tuple(self._of_joints) or ('',)

    def of_joint(self, joint: str) -> Parameters:
        """Those of one of the `joints`, or of the only one, which may be nameless."""
        return self._of_joints[joint] if self._of_joints else self

    def __getitem__(self, name: str) -> Value:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def get_float(self, name: str) -> float:
        """Value of a parameter of type float."""
        value = self._values[name]
        assert isinstance(value, float)
        return value

    def get_int(self, name: str) -> int:
        """Value of a parameter of type int."""
        value = self._values[name]
        assert isinstance(value, int)
        return value

    def get_bool(self, name: str) -> bool:
        """Value of a parameter of type bool."""
        value = self._values[name]
        assert isinstance(value, bool)
        return value

    def get_str(self, name: str) -> str:
        """Value of a parameter of type str."""
        value = self._values[name]
        assert isinstance(value, str)
        return value

    def get_floats(self, name: str) -> tuple[float, ...]:
        """Value of a list parameter."""
        value = self._values[name]
        assert isinstance(value, tuple)
        return cast(tuple[float, ...], value)

    def get_strs(self, name: str) -> tuple[str, ...]:
        """Value of a parameter that is a list of names."""
        value = self._values[name]
        assert isinstance(value, tuple)
        return cast(tuple[str, ...], value)

    def get_pair(self, name: str) -> tuple[float, float]:
        """Value of a list parameter of length 2."""
        low, high = self.get_floats(name)
        return low, high

    def get_triple(self, name: str) -> tuple[float, float, float]:
        """Value of a list parameter of length 3."""
        first, second, third = self.get_floats(name)
        return first, second, third

    def replaced(self, changes: Mapping[str, object]) -> Parameters:
        """A new set with some values changed, defaults staying defaults; raises ParameterError."""
        return Parameters({**self._given, **changes})


def missing_limits(p: Parameters) -> list[str]:
    """Names of the limits of v that are infinite."""
    return [name for name in LIMITS if isinf(p.get_float(name))]


def check_names(names: Iterable[str], joints: Iterable[str] = ()) -> None:
    """Raise ParameterError for the first unknown name, naming the nearest valid one."""
    for name in names:
        if name not in BY_NAME:
            valid = [*BY_NAME, *(f'{joint}.{own}' for joint in joints for own in BY_NAME)]
            near = difflib.get_close_matches(name, valid, n=1, cutoff=0.0)[0]
            raise ParameterError(name, UNTOLD, 'is not a parameter', f'did you mean {near}?')


def _of_joint(
    joint: str, shared: Mapping[str, object], own: Mapping[str, object],
) -> Parameters:
    values = values_of(joint, shared, own)
    try:
        return Parameters(values)
    except ParameterError as error:
        if error.name in own:
            raise error.under(joint) from None
        raise


def check_value(parameter: Parameter, value: object) -> Value:
    """Return value in the type of the parameter; raises ParameterError."""
    default = parameter.default
    if isinstance(default, bool):
        return _flag(parameter, value)
    if isinstance(default, str):
        return _word(parameter, value)
    if isinstance(default, tuple):
        return _names(parameter, value) if parameter.names else _reals(parameter, value)
    number = _real(parameter, value)
    if not isinstance(default, int):
        return number
    if number != int(number):
        raise ParameterError(parameter.name, value, 'must be a whole number')
    # Beyond 2^53 the detour over a float would lose digits.
    return value if isinstance(value, int) else int(number)


def _flag(parameter: Parameter, value: object) -> bool:
    if isinstance(value, str) and value.lower() in ('true', 'false'):
        return value.lower() == 'true'
    if not isinstance(value, bool):
        raise ParameterError(parameter.name, value, 'must be true or false')
    return value


def _word(parameter: Parameter, value: object) -> str:
    if 'true' in parameter.choices and isinstance(value, (bool, str)):
        value = str(value).lower()  # YAML and ROS 2 take true and false for more than words
    if not isinstance(value, str):
        raise ParameterError(parameter.name, value, 'must be a text')
    if parameter.choices and value not in parameter.choices:
        raise ParameterError(
            parameter.name, value, 'must be one of ' + ', '.join(parameter.choices)
        )
    return dict(parameter.aliases).get(value, value)


def _names(parameter: Parameter, value: object) -> tuple[str, ...]:
    if isinstance(value, str):
        value = [name.strip() for name in value.strip('[] ').split(',') if name.strip()]
    if not isinstance(value, Iterable) or isinstance(value, Mapping):
        raise ParameterError(parameter.name, value, 'must be a list of names')
    names = list(value)
    for name in names:
        if not isinstance(name, str) or not NAME.fullmatch(name) or names.count(name) > 1:
            raise ParameterError(
                parameter.name, names, 'must be a list of names',
                'each once, of letters, digits and single _, a letter first; quote true, on, ...',
            )
    return tuple(names)


def _reals(parameter: Parameter, value: object) -> tuple[float, ...]:
    if isinstance(value, str):
        listed = value.strip('[] ')
        value = listed.split(',') if listed else []
    if isinstance(value, (bool, int, float)) or not isinstance(value, Iterable):
        raise ParameterError(parameter.name, value, 'must be a list of numbers')
    numbers = tuple(_real(parameter, element) for element in value)
    if parameter.length is not None and len(numbers) != parameter.length:
        raise ParameterError(
            parameter.name, list(numbers), f'must have {parameter.length} numbers'
        )
    if not (numbers or parameter.may_be_empty):
        raise ParameterError(parameter.name, [], 'must have at least one number')
    return numbers


def _real(parameter: Parameter, value: object) -> float:
    if isinstance(value, str):
        # YAML 1.1 reads 1e-5 (no point, no sign) as a text, and tools of ROS 2 send .inf as one.
        try:
            value = float(value.replace('.inf', 'inf'))
        except ValueError:
            raise ParameterError(parameter.name, value, 'must be a number') from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParameterError(parameter.name, value, 'must be a number')
    try:
        number = float(value)
    except OverflowError:
        raise ParameterError(parameter.name, '...', 'is too large for a number') from None
    if isnan(number) or not (isfinite(number) or parameter.infinite):
        raise ParameterError(parameter.name, number, 'must be finite')
    if isfinite(number) and abs(number) > LARGEST:
        raise ParameterError(
            parameter.name, number, f'must be within ±{LARGEST:g}', 'choose another unit'
        )
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    if number < parameter.low or (parameter.above and number == parameter.low):
        sign = '>' if parameter.above else '>='
        raise ParameterError(parameter.name, number, f'must be {sign} {parameter.low:g}{unit}')
    if number > parameter.high:
        raise ParameterError(parameter.name, number, f'must be <= {parameter.high:g}{unit}')
    return number
