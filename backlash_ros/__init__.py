"""Adaptive backlash inverse control as ROS 2 nodes and command-line tools."""

__version__ = '0.2.0'
