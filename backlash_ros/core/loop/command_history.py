"""Finds which v acted over each sample interval, from commands, from reports, or from both."""

from collections import deque
from math import inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.loop.loop_statistics import LoopStatistics
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import Array

Stamps = NDArray[np.int64]  # [ns], of one clock

LOOKS = 10  # conclusive looks at the origin of reports after which it counts as settled
REPORTED = 0.9  # fraction of the samples that must have reports for these to be believed
# Consecutive outputs with a report for each of their intervals after which reports are believed,
# and without, after which they are given up. Messages unrelated to the samples match an interval
# every other time at most: 20 times in a row with a probability of one in a million.
CONSISTENT = 20
# Commands and reports that are kept: more than pile up while the controller stalls.
KEPT_COMMANDS = 256


def report_use(p: Parameters) -> str:
    """Return the effective use_applied_control: 'false' in lockstep, as every v then acts at once.

    With control.delay_samples 'auto' is 'false', too: v may be reported before or after the delay.
    """
    use: str = p.estimator.use_applied_control
    return 'false' if p.lockstep or (use == 'auto' and p.control.delay_samples > 0) else use


class ReportTrust:
    """Decides whether reports are used: always, never, or ('auto') while none are missing.

    With 'auto' they are used from the first one on. A driver that leaves one out among the first
    CONSISTENT has to send as many in a row before they are used again. use: see report_use.
    """

    def __init__(self, use: str) -> None:
        self.trusted, self._auto = use == 'true', use == 'auto'
        self._contrary = 0  # outputs in a row that speak against `trusted`
        self._first = 0  # outputs in a row with reports from the first one on; CONSISTENT: settled

    def note(self, complete: bool) -> bool:
        """Note whether each interval before an output had its report; return `trusted`."""
        if self._auto and self._first < CONSISTENT:
            self._first = self._first + 1 if complete else CONSISTENT if self.trusted else 0
            self.trusted = complete
        elif self._auto:
            self._contrary = 0 if complete is self.trusted else self._contrary + 1
            if self._contrary == CONSISTENT:
                self.trusted, self._contrary = complete, 0
        return self.trusted


class ReportOrigin:
    """Finds the zero of the reports, as a motor encoder may not have been zeroed.

    A first-order lag r(k) - b = p (r(k-1) - b) + (1 - p) v(k) is a straight line of r(k) - v(k)
    over r(k-1) - v(k); at rest or saturated p = 1. Its residuals must be small beside b, as a
    driver that limits v to one side has no other zero. value: b; 0 until another one is certain.
    before: the estimate at the first report.
    """

    def __init__(self) -> None:
        self.value = 0.0
        self.before: Estimate | None = None
        self.restart()

    def restart(self) -> None:
        """Look for it again: the driver was restarted, and its encoder perhaps zeroed."""
        self._looks = self._new = 0  # _new: pairs since the last look
        self._pairs: deque[tuple[float, float]] = deque(maxlen=201)

    def changed_by(self, report: float, command: float, known: Estimate | None = None) -> bool:
        """Take in the reported and the commanded v of an interval; return if `value` has changed.

        known: the present estimate; if it was learned with another `value`, it becomes void.
        """
        look_after, correlated, significant = 20, 10.0, 5.0  # intervals, intervals, std
        if not self._pairs:
            self.before = known
        if self._looks == LOOKS:
            return False
        self._pairs.append((report, command))
        self._new += 1
        if self._new <= look_after:
            return False
        self._new = 0
        r, v = np.array(self._pairs).T
        y, x = r[1:] - v[1:], r[:-1] - v[1:]
        y_mean, x_mean = float(y.mean()), float(x.mean())
        spread = float(((x - x_mean) ** 2).sum())
        rounding = 1e-9 * float(np.abs(self._pairs).max())
        if spread <= len(x) * rounding**2:
            return False
        p = float((x - x_mean) @ (y - y_mean)) / spread
        rest = float(np.mean((y - y_mean - p * (x - x_mean)) ** 2))
        p_std = sqrt(correlated * rest / spread)
        if not 1.0 - p > significant * p_std + 1e-6:
            return False
        self._looks += 1
        found = (y_mean - p * x_mean) / (1.0 - p)
        std = sqrt(correlated * rest / len(x) + (p_std * (x_mean - found)) ** 2) / (1.0 - p)
        if abs(found - self.value) <= significant * max(std, sqrt(rest)) + rounding:
            return False
        self.value, self._looks = found, LOOKS
        return True


def without_origin(reports: Array, commands: Array) -> Array:
    """Return the reports of a record minus their origin; nan where there is no report."""
    origin = ReportOrigin()
    for report, command in zip(reports.tolist(), commands.tolist(), strict=True):
        if report == report and command == command:
            origin.changed_by(report, command)
    return reports - origin.value


class CommandHistory:
    """Published commands by time [ns], and the applied ones if the driver reports them.

    The v of an interval is the newest one that the driver has at its end; one that cannot have
    arrived by then is late. v is taken to travel as long as y. newest_ns: when the newest command
    left, of whichever controller. output_ns: stamp of the newest output that was used.
    """

    def __init__(self, sample_period_s: float, use: str = 'true',
                 counts: LoopStatistics | None = None) -> None:
        self.counts = counts or LoopStatistics()
        self.trust, self.origin = ReportTrust(use), ReportOrigin()
        self.newest_ns = self.output_ns = 0
        self._period_ns = sample_period_s * 1e9
        self._transit_ns = 0.0  # median time from one node to the other
        self._published: deque[tuple[int, float]] = deque(maxlen=KEPT_COMMANDS)
        self._reported: deque[tuple[int, float]] = deque(maxlen=KEPT_COMMANDS)

    def note_transit(self, passed_ns: float) -> None:
        step = 1e-3 * self._period_ns
        median = self._transit_ns + (step if passed_ns > self._transit_ns else -step)
        # Clocks of two hosts may differ by more than any message takes.
        self._transit_ns = min(max(median, 0.0), 0.25 * self._period_ns)

    def publish(self, v: float, stamp_ns: int) -> None:
        self._published.append((stamp_ns, v))
        self.newest_ns = stamp_ns

    def report(self, v: float, stamp_ns: int) -> None:
        """Note an applied v and its stamp; it is reported just before the output it led to."""
        self._reported.append((stamp_ns, v))

    def over(self, intervals: int, end_ns: int, due_ns: float) -> tuple[list[float], list[float]]:
        """Return v over each of the newest intervals, oldest first, and a v for each that may have
        acted instead: a command that left within a period of the deciding time, or nan.

        end_ns, due_ns: when the last interval ended, and when it should have.
        """
        # A driver that was held up reads y before the commands that came meanwhile, so a command
        # counts only if it left earlier than that by the time that messages take.
        latest_ns = min(due_ns, end_ns) - self._transit_ns
        times_ns = [latest_ns - i * self._period_ns for i in range(intervals - 1, -1, -1)]
        self.counts.late += self._published[-1][0] >= times_ns[0]
        acted, others = zip(*map(self.at, times_ns), strict=True)
        return list(acted), list(others)

    def newest_report(self, end_ns: int) -> float:
        """Return the v reported for the interval up to end_ns, or nan if a command is newer."""
        if self._reported and end_ns > self.newest_ns + self._period_ns \
                and self._reported[-1][0] > end_ns - 1.5 * self._period_ns:
            return self._reported[-1][1] - self.origin.value
        return nan

    def reported_over(self, intervals: int, end_ns: int, unsent: int = 0) -> list[float]:
        """Return the reports since the last output, one per interval; [] if incomplete or unused.

        unsent: intervals at whose end the driver was held up, and neither measured nor reported:
        the v of its next report acted all the time.
        """
        begin_ns, self.output_ns = self.output_ns, end_ns
        stamp_ns, reports = begin_ns, []
        while self._reported and self._reported[0][0] <= end_ns:
            stamp_ns, v = self._reported.popleft()
            if stamp_ns > begin_ns:
                reports.append(v - self.origin.value)
        if reports and len(reports) == intervals - unsent:
            reports += reports[-1:] * unsent
        # The report of the newest interval may still be under way while older ones are here.
        complete = len(reports) == intervals and stamp_ns > end_ns - 0.5 * self._period_ns
        if not self.trust.note(complete):
            return []
        self.counts.unreported += not complete
        return reports if complete else []

    def at(self, time_ns: float) -> tuple[float, float]:
        """Return the newest v that had left by then, and one next to it that may act, or nan."""
        later_ns, later = inf, nan
        for i in range(len(self._published) - 1, -1, -1):
            stamp_ns, v = self._published[i]
            if stamp_ns < time_ns:
                since, until = time_ns - stamp_ns, later_ns - time_ns
                if min(since, until) > self._period_ns:
                    return v, nan
                # It may not have arrived yet; or the next one has, by the clock of another machine.
                older = self._published[i - 1][1] if i else nan
                return v, older if since <= until else later
            later_ns, later = stamp_ns, v
        return self._published[0][1], nan


def v_of_intervals(index: NDArray[np.int64], output_ns: Stamps, command_ns: Stamps, v: Array,
                   reported: bool) -> Array:
    """Return v over the interval after each sample, (N,), N = index[-1] + 1; nan before any v.

    index: number of each sample whose y was heard, rising from 0. output_ns: stamps of these y.
    command_ns, v (M,): messages of v in the order of time. reported: whether they are reports of
    the v that acted, one just before each y.
    """
    outputs, commands = ((each - output_ns[0]).astype(float) for each in (output_ns, command_ns))
    ends = np.interp(np.arange(1, index[-1] + 2), index, outputs)
    ends[-1] = inf
    acted: Array = np.append(v, nan)[np.searchsorted(commands, ends, side='right') - 1]
    if reported:
        until = np.searchsorted(commands, outputs, side='right')
        intervals, reports = np.diff(index), np.diff(until)
        # One report per interval: in their order, as those of a driver that was held up come in a
        # burst. A single one: nothing was sampled in between, and its v acted all the time.
        for i in np.flatnonzero((intervals > 1) & ((reports == intervals) | (reports == 1))):
            acted[index[i]:index[i + 1]] = v[until[i]:until[i + 1]]
    return acted
