"""Adaptive backlash inverse control as ROS 2 nodes and command-line tools."""

import os
import sys

__version__ = '0.2.0'


def starts_one_of(*executables: str) -> bool:
    """Whether this process is starting one of these executables, which are still being imported."""
    # With -m, sys.argv[0] is '-m' until the module is found; else it is the installed script.
    return bool(sys.argv) and os.path.basename(sys.argv[0]) in ('-m', *executables)
