"""A topic that is recorded."""

from __future__ import annotations

from dataclasses import dataclass

from rosbags.interfaces import Connection

from backlash_ros.core.loop.sample_counter import UNNUMBERED


@dataclass
class Channel:
    """A recorded topic: what came in, and how many messages were missed on the way."""

    topic: str
    several_publishers: bool
    name: str = ''  # with namespace and remappings, as it is recorded
    connection: Connection | None = None
    received: int = 0
    recorded: int = 0
    missed: int = 0
    sequence: int = UNNUMBERED

    def count(self, sequence: int) -> None:
        """Take note of a message."""
        self.received += 1
        if sequence == UNNUMBERED or self.several_publishers:
            return
        if self.sequence != UNNUMBERED and sequence > self.sequence + 1:
            self.missed += sequence - self.sequence - 1
        self.sequence = sequence
