"""Finds the steps by which wall clocks have been set, so that bookkeeping can take them out."""

import time


class WallClock:
    """set_ns, of_stamps_ns: by how much this clock, and that of the stamps, have been set since the
    first look; stamps of another machine do not follow this clock.

    Slewing, which changes the rate by less than a thousandth, is no step: the period follows it.
    """

    def __init__(self) -> None:
        self.set_ns = self.of_stamps_ns = 0
        self._ahead_ns: int | None = None  # wall clock minus steady clock
        self._stamps_ns = 0  # stamps minus steady clock
        self._step_ns = self._until_ns = 0  # a step that stamps may still follow, and until when

    def look(self, wall_ns: int, steady_ns: int, stamp_ns: int) -> None:
        """Take in what both clocks show as a message with this stamp is heard [ns]."""
        least_ns, longest_ns = 1_000_000, 1_000_000_000  # smallest step, longest wait in a queue
        ahead_ns, stamps_ns = wall_ns - steady_ns, stamp_ns - steady_ns
        if self._ahead_ns is not None and abs(ahead_ns - self._ahead_ns) > least_ns:
            self.set_ns += ahead_ns - self._ahead_ns
            self._step_ns += ahead_ns - self._ahead_ns
            self._until_ns = steady_ns + longest_ns
        shown_ns = stamps_ns - self._stamps_ns
        if self._step_ns and abs(shown_ns - self._step_ns) < 0.5 * abs(self._step_ns):
            self.of_stamps_ns, self._step_ns = self.of_stamps_ns + self._step_ns, 0
        elif steady_ns > self._until_ns:
            self._step_ns = 0
        self._ahead_ns = ahead_ns
        if not self._step_ns:
            self._stamps_ns = stamps_ns

    def look_now(self, stamp_ns: int) -> None:
        at_once_ns = 100_000  # if more passes, the process was interrupted between both clocks
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < at_once_ns:
            self.look(wall_ns, before_ns, stamp_ns)
