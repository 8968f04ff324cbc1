"""Which v the plant had over each sample interval, as far as the controller can know."""

from __future__ import annotations

from collections import deque
from math import nan

# Commands that may be under way: more than a stall of the controller can leave behind.
REMEMBERED = 256
LONGEST_TRANSIT = 0.25  # of a period: what is taken into account
TRANSIT_STEP = 1e-3  # of a period: by which its median follows with every output


class CommandHistory:
    """Published commands by time, and applied ones where the driver reports them.

    The driver applies over an interval the newest v it has when the interval ends with the next
    sample. So a v that cannot have been there when that sample was taken came too late, and the one
    before it was in use: v is as long under way as y is. Times are those of one clock [ns].
    """

    def __init__(self, sample_period_s: float) -> None:
        self.late = 0  # commands that missed their sample
        self.unreported = 0  # outputs without a matching report of the applied v
        self._period_ns = sample_period_s * 1e9
        self._output_ns = 0  # stamp of the newest output
        self._transit_ns = 0.0  # median time from one node to the other
        self._published: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._reported: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)

    def note_transit(self, passed_ns: float) -> None:
        """Note how long an output was under way."""
        # Clocks of two hosts may differ by more than any message takes.
        longest, step = LONGEST_TRANSIT * self._period_ns, TRANSIT_STEP * self._period_ns
        median = self._transit_ns + (step if passed_ns > self._transit_ns else -step)
        self._transit_ns = min(max(median, 0.0), longest)

    def publish(self, v: float, stamp_ns: int) -> None:
        """Note a command and when it left."""
        self._published.append((stamp_ns, v))

    def report(self, v: float, stamp_ns: int) -> None:
        """Note an applied v and when the driver said so, just before the output it led to."""
        self._reported.append((stamp_ns, v))

    def over(self, intervals: int, end_ns: int, due_ns: float) -> list[float]:
        """v over each of the newest `intervals`, oldest first; the last one ended at end_ns.

        due_ns: when it should have ended, and so a whole number of periods after the others.
        Empty if it was the newest command in all of them, as usual.
        """
        ends_ns = [due_ns - i * self._period_ns for i in range(intervals - 1, 0, -1)] + [end_ns]
        # What left later than that was not there.
        latest_ns = [each - self._transit_ns for each in ends_ns]
        if self._published[-1][0] < latest_ns[0]:
            return []
        self.late += 1
        return [self._at(each) for each in latest_ns]

    def begin(self, end_ns: int) -> None:
        """Note the first output: reports up to here belong to nothing."""
        self._output_ns = end_ns

    def newest_report(self) -> float:
        """The newest reported v, nan before the first."""
        return self._reported[-1][1] if self._reported else nan

    def reported_over(self, intervals: int, end_ns: int) -> list[float]:
        """Reports since the last output; empty, and counted, unless there is one per interval."""
        begin_ns, self._output_ns = self._output_ns, end_ns
        stamp_ns, reports = begin_ns, []
        while self._reported and self._reported[0][0] <= end_ns:
            stamp_ns, v = self._reported.popleft()
            if stamp_ns > begin_ns:
                reports.append(v)
        # The report of the newest interval may still be under way while older ones are here.
        if len(reports) == intervals and stamp_ns > end_ns - 0.5 * self._period_ns:
            return reports
        self.unreported += 1
        return []

    def _at(self, time_ns: float) -> float:
        for stamp_ns, v in reversed(self._published):
            if stamp_ns < time_ns:
                return v
        return self._published[0][1]
