"""Parameters of a node from the one table: overrides checked, descriptors filled in, live ones."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import BY_NAME, PARAMETERS, Parameter

# Declared by rclpy itself in every node.
ROS_OWN = {'use_sim_time', 'start_type_description_service'}


# What decides on the topics and the life of a node stays as it was at its start.
FIXED = (
    'autostart', 'estimator.use_applied_control', 'io.best_effort', 'io.field', 'io.joint',
    'io.style', 'lockstep', 'wait_for_subscribers',
)


def declare_parameters(
    node: Node, executable: str, reconfigurable: bool = False,
) -> Parameters:
    """Declare what the table says this executable uses; return the complete, checked set.

    reconfigurable: whether all but the FIXED ones may change while the node is unconfigured.
    node: created with automatically_declare_parameters_from_overrides, the public way to learn
    which names were given: rclpy ignores a given name that nobody declares. Raises ParameterError.
    """
    given: dict[str, Any] = {
        name: parameter.value for name, parameter in _declared(node).items() if name not in ROS_OWN
    }
    parameters = Parameters(given)
    for name in given:
        node.undeclare_parameter(name)
    node.declare_parameters('', [
        (p.name, _ros_value(parameters[p.name]), describe(p, reconfigurable))
        for p in PARAMETERS if executable in p.used_by
    ], ignore_override=True)
    return parameters


def describe(parameter: Parameter, reconfigurable: bool = False) -> ParameterDescriptor:
    """What tools like rqt and `ros2 param describe` show."""
    changes = parameter.live or (reconfigurable and parameter.name not in FIXED)
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        name=parameter.name, description=parameter.description + unit,
        additional_constraints=_constraints(parameter), read_only=not changes,
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


class LiveParameters:
    """Lets parameters change in a running node, all or nothing.

    check: raises ParameterError for a set that the node cannot take up. apply: takes it up.
    is_free: whether those may change as well that are not live: the node is unconfigured.
    """

    def __init__(
        self, node: Node, parameters: Parameters, check: Callable[[Parameters], object],
        apply: Callable[[Parameters], None], is_free: Callable[[], bool] = lambda: False,
    ) -> None:
        self.parameters = parameters
        self._check, self._apply, self._is_free = check, apply, is_free
        node.add_pre_set_parameters_callback(_as_declared)
        node.add_on_set_parameters_callback(self._on_set)
        node.add_post_set_parameters_callback(self._post_set)

    def _on_set(self, changes: list[RosParameter]) -> SetParametersResult:
        for change in changes:
            if change.name in BY_NAME and not (BY_NAME[change.name].live or self._is_free()):
                return SetParametersResult(successful=False, reason=(
                    f'{change.name} is read-only while the node is configured: deactivate it and '
                    'clean it up first'
                ))
        try:
            self._check(self._with(changes))
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _post_set(self, changes: list[RosParameter]) -> None:
        self.parameters = self._with(changes)
        self._apply(self.parameters)

    def _with(self, changes: list[RosParameter]) -> Parameters:
        return self.parameters.replaced(
            {change.name: change.value for change in changes if change.name in BY_NAME}
        )


def _declared(node: Node) -> dict[str, RosParameter]:
    # rclpy annotates the values of this dictionary as plain values; they are Parameters.
    declared: dict[str, Any] = dict(node.get_parameters_by_prefix(''))
    return declared


def _ros_value(value: object) -> object:
    if value == ():
        return RosParameter.Type.DOUBLE_ARRAY  # declared and not set: ROS has no empty lists
    return list(value) if isinstance(value, tuple) else value


def _constraints(parameter: Parameter) -> str:
    if parameter.choices:
        return 'one of ' + ', '.join(parameter.choices)
    rules = []
    if isfinite(parameter.low):
        rules.append(f'{">" if parameter.above else ">="} {parameter.low:g}')
    if isfinite(parameter.high):
        rules.append(f'<= {parameter.high:g}')
    return ' and '.join(rules)


def _as_declared(changes: list[RosParameter]) -> list[RosParameter]:
    """Turn what rclpy alone would refuse into the declared type.

    Whole numbers given for a float; true and false given for a word that may be 'true'.
    """
    return [
        RosParameter(change.name, value=_in_type_of(BY_NAME[change.name], change))
        if change.name in BY_NAME else change
        for change in changes
    ]


def _in_type_of(parameter: Parameter, change: RosParameter) -> Any:
    if change.type_ == RosParameter.Type.INTEGER and isinstance(parameter.default, float):
        return float(change.value)
    if change.type_ == RosParameter.Type.BOOL and 'true' in parameter.choices:
        return str(change.value).lower()
    return change.value
