"""Every parameter, declared once (table), and the check of what somebody sets."""

from backlash_ros.core.parameters.parameter import (
    UNTOLD,
    Parameter,
    ParameterError,
    Value,
    as_yaml,
    check_value,
)
from backlash_ros.core.parameters.parameter_set import Parameters, check_names, entry_of
from backlash_ros.core.parameters.table import (
    BRINGUP,
    BY_NAME,
    CONTROLLER,
    NODES,
    NOISE,
    PLANT,
    RECORDER,
    REFERENCE_NODE,
    PlantModel,
)

__all__ = [
    'BRINGUP', 'BY_NAME', 'CONTROLLER', 'NODES', 'NOISE', 'PLANT', 'RECORDER', 'REFERENCE_NODE',
    'UNTOLD', 'Parameter', 'ParameterError', 'Parameters', 'PlantModel', 'Value', 'as_yaml',
    'check_names', 'check_value', 'entry_of',
]
