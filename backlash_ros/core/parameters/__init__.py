"""Every parameter, declared once (table), and the check of what somebody sets."""

from backlash_ros.core.parameters.parameter import check_value
from backlash_ros.core.parameters.parameter_set import Parameters, check_names
from backlash_ros.core.parameters.table import NOISE

__all__ = ['NOISE', 'Parameters', 'check_names', 'check_value']
