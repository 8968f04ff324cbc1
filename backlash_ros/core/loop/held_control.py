"""Which v a driver applies that holds the newest one it has."""

from __future__ import annotations


class HeldControl:
    """The newest v acts from its arrival on; before, the one before it."""

    def __init__(self) -> None:
        self.newest = 0.0
        self._before, self._arrived_ns = 0.0, 0

    def take(self, v: float, arrived_ns: int) -> None:
        """A v has come, at this time."""
        self._before, self.newest, self._arrived_ns = self.newest, v, arrived_ns

    def over(self, ended_ns: float) -> float:
        """The v of a sample period that ended then: it counts for all of it if it came in it."""
        return self.newest if self._arrived_ns < ended_ns else self._before
