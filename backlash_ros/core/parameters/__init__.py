"""A complete, checked set of parameter values, of one loop or of all joints of an arm.

table.py declares every parameter, parameter.py says how one is checked.
"""

import difflib
from collections.abc import Iterable, Iterator, Mapping
from math import hypot, sqrt
from pathlib import PurePath
from typing import Any

from backlash_ros.core.parameters.parameter import (
    UNTOLD,
    Parameter,
    ParameterError,
    Value,
    as_yaml,
    attributes_of,
    check_value,
)
from backlash_ros.core.parameters.table import (
    BRINGUP,
    BY_NAME,
    CONTROLLER,
    NODES,
    NOISE,
    PLANT,
    RECORDER,
    REFERENCE_NODE,
    Bounds,
    ParameterTree,
)

__all__ = [
    'BRINGUP', 'BY_NAME', 'CONTROLLER', 'NODES', 'NOISE', 'PLANT', 'RECORDER', 'REFERENCE_NODE',
    'UNTOLD', 'Bounds', 'Parameter', 'ParameterError', 'Parameters', 'Value', 'as_yaml',
    'check_names', 'check_value', 'entry_of',
]


class Parameters(ParameterTree, Mapping[str, Value]):
    """Values by group, `p.control.max`, and by flat name, `p['control.max']`.

    joint_names: the `joints`, or one empty name for a single loop. given: the values that are not
    left to their defaults, as they were given.
    """

    joint_names: tuple[str, ...]
    given: dict[str, object]
    _values: dict[str, Value]
    _of_joints: dict[str, 'Parameters']

    def __init__(self, values: Mapping[str, object] | None = None) -> None:
        """Take given values and the defaults of all others; raises ParameterError."""
        given = dict(values or {})
        joints: Any = check_value(BY_NAME['joints'], given.get('joints', ()))
        own: dict[str, dict[str, object]] = {joint: {} for joint in joints}
        shared: dict[str, object] = {}
        for name, value in given.items():
            first, _, rest = name.partition('.')
            if rest and first in own:
                own[first][rest] = value
            else:
                shared[name] = value
        if taken := [joint for joint in joints if joint in {n.partition('.')[0] for n in BY_NAME}]:
            raise ParameterError('joints', taken[0], 'is the first word of a parameter',
                                 'give the joint another name')
        check_names(shared, joints)
        checked: dict[str, Any] = {
            name: check_value(p, shared[name]) if name in shared else p.default
            for name, p in BY_NAME.items()
        }
        if NOISE not in shared:
            # By default the estimator knows the noise that is simulated.
            checked[NOISE] = max(checked[NOISE], hypot(
                checked['output_noise_std'], checked['output_quantum'] / sqrt(12.0)))
        vars(self).update(attributes_of(ParameterTree, checked))
        self._values, self.given, self.joint_names = checked, given, joints or ('',)
        self._of_joints = {joint: _of_joint(joint, shared, own[joint]) for joint in joints}

    def of_joint(self, joint: str) -> 'Parameters':
        return self._of_joints[joint] if self._of_joints else self

    def __getitem__(self, name: str) -> Value:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def replaced(self, changes: Mapping[str, object]) -> 'Parameters':
        """Return a new set with some values changed, defaults left open; raises ParameterError."""
        return Parameters({**self.given, **changes})

    @property
    def missing_limits(self) -> list[str]:
        names = 'control.min', 'control.max', 'control.rate_max'
        return [name for name in names if self[name] == BY_NAME[name].default]


def check_names(names: Iterable[str], joints: Iterable[str] = ()) -> None:
    """Raise ParameterError for the first unknown name, naming the nearest valid one."""
    for name in names:
        if name not in BY_NAME:
            valid = [*BY_NAME, *(f'{joint}.{own}' for joint in joints for own in BY_NAME)]
            near = difflib.get_close_matches(name, valid, n=1, cutoff=0.0)[0]
            raise ParameterError(name, UNTOLD, 'is not a parameter', f'did you mean {near}?')


def entry_of(name: str) -> Parameter | None:
    """Return the table entry of a parameter, or of one with a joint's name before it, or None."""
    return BY_NAME.get(name) or BY_NAME.get(name.partition('.')[2])


def _of_joint(joint: str, shared: Mapping[str, object], own: Mapping[str, object]) -> Parameters:
    for name, value in own.items():
        entry = BY_NAME.get(name)
        if entry and (entry.per_node or CONTROLLER not in entry.used_by):
            raise ParameterError(f'{joint}.{name}', value, 'is not for one joint alone',
                                 f'set {name}')
    values = {**shared, **own, 'io.joint': joint}
    del values['joints']
    if 'plant.denominator' not in values:  # nothing is known of this joint: v = y_m
        values |= {
            'plant.numerator': (1.0,), 'plant.denominator': (1.0, 0.0), 'estimator.law': 'fixed',
            'structure': 'proportional', 'proportional.f': 0.0, 'estimator.initial.m': 1.0,
            'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
        }
    if file := str(values.get('estimates.file', '')):
        path = PurePath(file)
        values['estimates.file'] = file.replace('{joint}', joint) if '{joint}' in file else str(
            path.with_name(f'{path.stem}-{joint}{path.suffix}'))
    try:
        return Parameters(values)
    except ParameterError as error:
        if error.name in own:
            error.name, error.args = f'{joint}.{error.name}', (f'{joint}.{error}',)
        raise
