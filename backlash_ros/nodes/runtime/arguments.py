"""Options of a node besides those of ROS."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NoReturn

from backlash_ros.nodes.runtime.spin import BAD_INPUT


class OptionParser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and end the process."""
        self.exit(BAD_INPUT, f'{self.prog}: {message} (--help lists the options)\n')


def ros_arguments(arguments: Sequence[str]) -> list[str]:
    """The part between --ros-args and --, all of them."""
    found, inside = [], False
    for argument in arguments:
        inside = (inside or argument == '--ros-args') and argument != '--'
        if inside:
            found.append(argument)
    return found
