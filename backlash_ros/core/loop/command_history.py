"""Which v the plant had over each sample interval, as far as the controller can know."""

from __future__ import annotations

from collections import deque
from math import inf, nan

from backlash_ros.core.loop.report_use import ReportTrust, ReportUse

# Commands and reports that may wait: more than a stall of the controller can leave behind.
REMEMBERED = 256
LONGEST_TRANSIT = 0.25  # of a period: what is taken into account
TRANSIT_STEP = 1e-3  # of a period: by which its median follows with every output
FRESH = 1.5  # periods before an output up to which a report tells the v of its interval


class CommandHistory:
    """Published commands by time, and applied ones where the driver reports them.

    The driver applies over an interval the newest v it has when the interval ends with the next
    sample. So a v that cannot have been there when that sample was taken came too late, and the one
    before it was in use: v is as long under way as y is. Times are those of one clock [ns].
    """

    def __init__(self, sample_period_s: float, use: ReportUse = ReportUse.ALWAYS) -> None:
        self._trust = ReportTrust(use)
        self.late = 0  # commands that missed their sample
        self.unreported = 0  # outputs without a matching report while reports are used
        self._period_ns = sample_period_s * 1e9
        self._output_ns = 0  # stamp of the newest output
        self._transit_ns = 0.0  # median time from one node to the other
        self._published: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._reported: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)

    @property
    def uses_reports(self) -> bool:
        """Whether reports go before the own commands at present."""
        return self._trust.trusted

    def note_transit(self, passed_ns: float) -> None:
        """Note how long an output was under way."""
        # Clocks of two hosts may differ by more than any message takes.
        longest, step = LONGEST_TRANSIT * self._period_ns, TRANSIT_STEP * self._period_ns
        median = self._transit_ns + (step if passed_ns > self._transit_ns else -step)
        self._transit_ns = min(max(median, 0.0), longest)

    @property
    def newest_ns(self) -> int:
        """When the newest command left, 0 before the first one."""
        return self._published[-1][0] if self._published else 0

    def publish(self, v: float, stamp_ns: int) -> None:
        """Note a command and when it left."""
        self._published.append((stamp_ns, v))

    def report(self, v: float, stamp_ns: int) -> None:
        """Note an applied v and when the driver said so, just before the output it led to."""
        self._reported.append((stamp_ns, v))

    def over(
        self, intervals: int, end_ns: int, due_ns: float,
    ) -> tuple[list[float], list[float]]:
        """v over each of the newest `intervals`, oldest first; the last one ended at end_ns.

        due_ns: when it should have ended, and so a whole number of periods after the others.
        And for each the command that left next to it, where that was within a period of the time
        that decides: nobody knows how long it was under way. nan where there is none.
        """
        # A driver that was held up reads y first, and then the commands that came meanwhile.
        ends_ns = [min(due_ns, end_ns) - i * self._period_ns for i in range(intervals - 1, -1, -1)]
        # What left later than that was not there.
        latest_ns = [each - self._transit_ns for each in ends_ns]
        self.late += self._published[-1][0] >= latest_ns[0]
        pairs = [self._at(each) for each in latest_ns]
        return [v for v, _ in pairs], [other for _, other in pairs]

    def begin(self, end_ns: int) -> None:
        """Note the first output: reports up to here belong to nothing."""
        self._output_ns = end_ns

    def newest_report(self, end_ns: int) -> float:
        """The v reported for the interval that ended at end_ns, nan without one.

        It tells where the commands begin, even where it is not to be learned from.
        """
        if not self._reported:
            return nan
        stamp_ns, v = self._reported[-1]
        return v if stamp_ns > end_ns - FRESH * self._period_ns else nan

    def reported_over(self, intervals: int, end_ns: int, unsent: int = 0) -> list[float]:
        """Reports since the last output, one per interval; empty where they are not to be used.

        unsent: intervals at whose end the driver was held up: it has neither measured nor reported
        then, and the v of its next report was in use all the time. Empty, and counted, where there
        is not one per interval though they are used.
        """
        begin_ns, self._output_ns = self._output_ns, end_ns
        stamp_ns, reports = begin_ns, []
        while self._reported and self._reported[0][0] <= end_ns:
            stamp_ns, v = self._reported.popleft()
            if stamp_ns > begin_ns:
                reports.append(v)
        if reports and len(reports) == intervals - unsent:
            reports += reports[-1:] * unsent
        # The report of the newest interval may still be under way while older ones are here.
        complete = len(reports) == intervals and stamp_ns > end_ns - 0.5 * self._period_ns
        if not self._trust.note(complete):
            return []
        self.unreported += not complete
        return reports if complete else []

    def _at(self, time_ns: float) -> tuple[float, float]:
        """The newest v that had left by then, and the one beside it that may have been in use."""
        later_ns, later = inf, nan
        for i in range(len(self._published) - 1, -1, -1):
            stamp_ns, v = self._published[i]
            if stamp_ns < time_ns:
                since, until = time_ns - stamp_ns, later_ns - time_ns
                if min(since, until) > self._period_ns:
                    return v, nan
                # It may not have arrived yet, or the next one had by the clock of another machine.
                older = self._published[i - 1][1] if i else nan
                return v, older if since <= until else later
            later_ns, later = stamp_ns, v
        return self._published[0][1], nan
