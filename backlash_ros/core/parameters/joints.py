"""Parameters of a controller with several joints: what all share, and what each has of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import PurePath

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import Parameter
from backlash_ros.core.parameters.table import BY_NAME, CONTROLLER, JOINTS

JOINT_MODEL, ESTIMATES_FILE = 'plant.denominator', 'estimates.file'
# A joint of which nobody has said what it is like: v = y_m, within its limits.
PASS_THROUGH: dict[str, object] = {
    'plant.numerator': (1.0,), JOINT_MODEL: (1.0, 0.0), 'estimator.law': 'fixed',
    'structure': 'proportional', 'proportional.f': 0.0, 'estimator.initial.m': 1.0,
    'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
}


def split(
    given: Mapping[str, object], joints: Iterable[str],
) -> tuple[dict[str, object], dict[str, dict[str, object]]]:
    """What all share, and what each joint has of its own, given as `<joint>.<name>`."""
    shared: dict[str, object] = {}
    own: dict[str, dict[str, object]] = {joint: {} for joint in joints}
    for name, value in given.items():
        first, _, rest = name.partition('.')
        if rest and first in own:
            own[first][rest] = value
        else:
            shared[name] = value
    return shared, own


def entry_of(name: str) -> Parameter | None:
    """What the table says of a declared parameter, that of one joint included."""
    return BY_NAME.get(name) or BY_NAME.get(name.partition('.')[2])


def check_joints(joints: Iterable[str]) -> None:
    """Raise ParameterError for a joint whose section would be taken for something else."""
    groups = {name.partition('.')[0] for name in BY_NAME}
    for joint in joints:
        if joint in groups:
            raise ParameterError(
                JOINTS, joint, 'is the first word of a parameter', 'give the joint another name'
            )


def values_of(
    joint: str, shared: Mapping[str, object], own: Mapping[str, object],
) -> dict[str, object]:
    """Values of one joint by the names of the table; raises ParameterError."""
    for name, value in own.items():
        entry = BY_NAME.get(name)
        if entry is not None and (entry.per_node or CONTROLLER not in entry.used_by):
            raise ParameterError(
                f'{joint}.{name}', value, 'is not for one joint alone', f'set {name}'
            )
    values = {**shared, **own, 'io.joint': joint}
    del values[JOINTS]
    if JOINT_MODEL not in values:
        values.update(PASS_THROUGH)
    if values.get(ESTIMATES_FILE):
        values[ESTIMATES_FILE] = file_of(str(values[ESTIMATES_FILE]), joint)
    return values


def file_of(file: str, joint: str) -> str:
    """A file of a joint: `{joint}` in its name, else the joint before its suffix."""
    if '{joint}' in file:
        return file.replace('{joint}', joint)
    path = PurePath(file)
    return str(path.with_name(f'{path.stem}-{joint}{path.suffix}'))
