"""What the driver reports to have applied, by joint."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from rclpy.node import Node

from backlash_ros.core.loop.command_history import REMEMBERED
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.inbox import Inbox


class Reports:
    """Taken when a loop looks for them: v and stamp [ns] of each joint since its last look."""

    def __init__(self, node: Node, io: DriverIo, joints: tuple[str, ...]) -> None:
        self._io = io
        self._inbox = Inbox(node, io.topics.applied_type, io.topics.applied, REMEMBERED)
        self._new: dict[str, deque[tuple[float, int]]] = {
            joint: deque(maxlen=REMEMBERED) for joint in joints
        }

    @property
    def publishers(self) -> int:
        """How many there are."""
        return self._inbox.publishers

    def of(self, joint: str) -> Iterator[tuple[float, int]]:
        """Those of a joint."""
        self._look()
        new = self._new[joint]
        while new:
            yield new.popleft()

    def forget(self) -> None:
        """Drop them all: they are of no use to a loop that begins later."""
        self._look()
        for new in self._new.values():
            new.clear()

    def _look(self) -> None:
        for message, info in self._inbox.take_all():
            stamp_ns = self._io.stamp_ns(info)
            for joint, v in self._io.values(message).items():
                self._new[joint].append((v, stamp_ns))
