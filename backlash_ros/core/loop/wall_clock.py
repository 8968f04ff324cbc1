"""Wall clocks without the steps by which somebody has set them, as bookkeeping wants them."""

import time


class WallClock:
    """set_ns, of_stamps_ns: by how much this clock, and with it that of stamps, was set since the
    first look; stamps of another machine do not follow.

    What slews the clock, by less than a thousandth, sets nothing: the period follows that.
    """

    def __init__(self) -> None:
        self.set_ns = self.of_stamps_ns = 0
        self._ahead_ns: int | None = None  # of the steady clock
        self._stamps_ns = 0  # the same of stamps
        self._step_ns = self._until_ns = 0  # that stamps may still show, and until when

    def look(self, wall_ns: int, steady_ns: int, stamp_ns: int) -> None:
        """Take in what both clocks show where a message with this stamp is heard [ns]."""
        least_ns, longest_ns = 1_000_000, 1_000_000_000  # of a step, and in the queue of messages
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
        at_once_ns = 100_000  # between both clocks the process may have lost its processor
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < at_once_ns:
            self.look(wall_ns, before_ns, stamp_ns)
