"""Arguments of ROS among those of a node."""

from __future__ import annotations

from collections.abc import Sequence


def ros_arguments(arguments: Sequence[str]) -> list[str]:
    """The part between --ros-args and --, all of them."""
    found, inside = [], False
    for argument in arguments:
        inside = (inside or argument == '--ros-args') and argument != '--'
        if inside:
            found.append(argument)
    return found
