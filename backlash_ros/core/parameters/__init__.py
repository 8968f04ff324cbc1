"""Every parameter, declared once (table), and the check of what somebody sets (validation)."""

from backlash_ros.core.parameters.validation import (
    NOISE,
    Parameters,
    check_names,
    check_value,
    missing_limits,
)

__all__ = ['NOISE', 'Parameters', 'check_names', 'check_value', 'missing_limits']
