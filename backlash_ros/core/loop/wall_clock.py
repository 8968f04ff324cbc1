"""The wall clock without the steps by which somebody has set it, as stamps of samples want it."""

import time


class WallClock:
    """set_ns: by how much it was set since the first look, by NTP or by hand.

    What slews it, by less than a thousandth, sets nothing: the period of the samples follows that.
    """

    def __init__(self) -> None:
        self.set_ns = 0
        self._ahead_ns: int | None = None  # of the steady clock

    def look(self, wall_ns: int, steady_ns: int) -> None:
        """Take in what both clocks show at one instant [ns]."""
        least_ns = 1_000_000  # more than the clock is slewed by between two looks
        ahead_ns = wall_ns - steady_ns
        if self._ahead_ns is not None and abs(ahead_ns - self._ahead_ns) > least_ns:
            self.set_ns += ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns

    def look_now(self) -> None:
        at_once_ns = 100_000  # between both clocks the process may have lost its processor
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < at_once_ns:
            self.look(wall_ns, before_ns)
