"""Counts samples by message and stamp, learns the period of a driver, and paces a reference."""

from collections import deque
from collections.abc import Sequence
from itertools import islice
from math import inf, isfinite, nan, sqrt
from typing import NamedTuple

import numpy as np

# Relative deviation from which on a period is taken to differ from that of the model.
OTHER_PERIOD = 0.003
# Sequence number that the middleware reports if it does not number messages.
UNNUMBERED = 2**64 - 1
# A stamp is never earlier than its sample, so a missing sample shows as a full period of lateness.
# Jitter of the sender up to this fraction of a period is not taken for a loss.
JITTER = 0.85
# For so many samples after a message that repeats y under a number of its own, numbers do not count
# samples: as many of them may be those of further repetitions.
MISNUMBERED = 50
CLOCK_SLACK = 0.01  # fraction of a period by which the sender's clock may run slow per sample


class Period(NamedTuple):
    """Mean period of a driver, its standard deviation, the median interval [s]; nan: unknown."""

    mean: float = nan
    std: float = nan
    median: float = nan

    def differs_from(self, nominal_s: float, tolerance: float) -> bool:
        """Whether the mean is off by more than this fraction for certain, and the median agrees."""
        off = self.mean - nominal_s
        return abs(off) > tolerance * nominal_s + 3.0 * self.std \
            and (self.median - nominal_s) * off > 0.5 * tolerance * nominal_s * abs(off)


class Timing(NamedTuple):
    """Timing of y; nan where it is not known. nominal_s: the period of the model.

    intervals_s: first decile, mean and last decile of the newest intervals between messages. age_s:
    median time from stamp to arrival. repeats_stamps: whether the driver repeats its stamps.
    """

    nominal_s: float
    period: Period = Period()
    intervals_s: tuple[float, float, float] = (nan, nan, nan)
    age_s: float = nan
    repeats_stamps: bool = False

    @property
    def is_stretched(self) -> bool:
        """Whether pauses lengthen the mean period, but not the median interval."""
        mean, std, _ = self.period
        return mean - self.nominal_s > 0.01 * self.nominal_s + 3.0 * std \
            and not self.period.differs_from(self.nominal_s, 0.01)

    @property
    def rate(self) -> float:
        """The rate of y [Hz] if it differs from that of the model, else nan.

        While the period is not known, nearly all intervals must be off to the same side by a tenth:
        losses and stalls lengthen only some of them, and repeated messages shorten only some.
        """
        # From 0.5 % on, minus the uncertainty of the period after a second.
        if self.period.differs_from(self.nominal_s, 0.0045) or self.is_stretched:
            return 1.0 / self.period.mean
        low, mean, high = self.intervals_s
        off = low > 1.1 * self.nominal_s or high < self.nominal_s / 1.1
        return 1.0 / mean if off and mean > 0.0 else nan


class DriverPeriod:
    """Learns the period of a driver from its stamps [ns]. period_ns: the one to count with.
    came_early: whether a sample has been counted that came before it was due."""

    def __init__(self, nominal_s: float) -> None:
        self.nominal_s, self.period_ns = nominal_s, 1e9 * nominal_s
        self._samples_ns: deque[int] = deque(maxlen=1000)
        self._messages_ns: deque[int] = deque(maxlen=51)
        self._ages_s: deque[float] = deque(maxlen=50)
        self._since_learned, self.came_early = 0, False  # samples

    def hear(self, stamp_ns: int, received_ns: int) -> None:
        """Take in any message of y: its stamp, and when it was received (0 if unknown)."""
        self._messages_ns.append(stamp_ns)
        if received_ns > 0:
            self._ages_s.append((received_ns - stamp_ns) * 1e-9)

    def follow(self, stamp_ns: int) -> None:
        self._samples_ns.append(stamp_ns)
        self._since_learned += 1

    def restart(self, stamp_ns: int) -> None:
        """Begin anew with this sample: the clock of the stamps has changed."""
        self._samples_ns.clear()
        self._samples_ns.append(stamp_ns)
        self._since_learned, self.came_early, self.period_ns = 0, False, 1e9 * self.nominal_s

    def learn(self) -> None:
        """Update the period to count with if it is time; best called when nothing waits for it."""
        if self._since_learned < 20:
            return
        self._since_learned = 0
        nominal_s, stamps, intervals = self.nominal_s, self._samples_ns, 50
        is_other = self.period_ns != 1e9 * nominal_s
        if not is_other and len(stamps) > intervals:
            periods = (stamps[-1] - stamps[-1 - intervals]) / self.period_ns
            if abs(periods - intervals) < OTHER_PERIOD * intervals:
                return  # as nearly always; what follows takes as long as computing a command
        found = self.newest(intervals)
        # Once another period was certain, a likely one suffices.
        if isfinite(found.mean) and (is_other or found.differs_from(nominal_s, OTHER_PERIOD)):
            off = abs(found.mean - nominal_s) > OTHER_PERIOD * nominal_s
            self.period_ns = 1e9 * (found.mean if off else nominal_s)

    def timing(self) -> Timing:
        intervals = 1e-9 * np.sort(np.diff(self._messages_ns)) if len(self._messages_ns) > 20 \
            else np.full(1, nan)
        tenth = len(intervals) // 10
        shares = float(intervals[tenth]), float(intervals.mean()), float(intervals[-1 - tenth])
        age_s = float(np.median(self._ages_s)) if len(self._ages_s) >= 20 else nan
        return Timing(self.nominal_s, self.newest(), shares, age_s)

    def newest(self, intervals: int = 1000) -> Period:
        """Return the period over so many intervals at most: the slope of stamps over samples.

        It is known to some 0.1 % after a second, despite losses and repetitions, and unknown if
        most intervals are far from one period, or scatter widely.
        """
        stamps = list(islice(reversed(self._samples_ns), intervals + 1))[::-1]
        if len(stamps) <= 20:
            return Period()
        times = 1e-9 * np.array([stamp - stamps[-1] for stamp in stamps])
        # Those of the last 2 s, but 20 intervals at least.
        times = times[min(int(np.count_nonzero(times < -2.0)), len(times) - 21):]
        ordered, nominal_s = np.sort(np.diff(times)), self.nominal_s
        quarter = len(ordered) // 4
        typical = float(ordered[quarter:-quarter].mean())
        if not abs(typical / nominal_s - 1.0) < 0.25:
            return Period()
        apart = 1 + len(times) // 300  # neighbours add little information
        times = times[::apart]
        numbers = np.array(numbered(times.tolist(), typical))
        n, t = numbers - numbers.mean(), times - times.mean()
        spread = float(n @ n)
        slope = float(n @ t) / spread if spread else nan
        rest = float(np.mean((t - slope * n) ** 2))
        # With more scatter, as of a driver that is held up all the time, the stamps do not show
        # which samples were left out.
        if not (slope > 0.0 and sqrt(rest) < 0.2 * nominal_s):
            return Period()
        # A process that is held up is late for some ten samples in a row: that is a single error.
        std = sqrt(max(10.0 / apart, 1.0) * rest / spread)
        return Period(slope, std, float(ordered[len(ordered) // 2]))


def numbered(times: Sequence[float], period_s: float, early: float = 0.3) -> list[float]:
    """Return the number of each sample, for stamps that are less than a period late.

    early: fraction of a period by which a stamp may be early.
    """
    number, numbers, due = 0.0, [0.0], times[0]
    for time in times[1:]:
        passed = max(int((time - due) / period_s + early), 0)
        number += passed
        numbers.append(number)
        late = time - due - passed * period_s
        due += passed * period_s + min(late, 0.01 * period_s)
    return numbers


class Output(NamedTuple):
    """A measured y, when it was sampled, sent and received [ns], and the number of its message.

    numbered: whether the numbers count samples; else they only tell one sender from another.
    """

    y: float
    stamp_ns: int
    sent_ns: int
    received_ns: int
    sequence: int
    numbered: bool = True

    @property
    def counted(self) -> tuple[int, int, bool, int]:
        return self.stamp_ns, self.sequence, self.numbered, self.received_ns


class Arrival(NamedTuple):
    """How a message counts. is_sample: False for a repeated, early, old or another sender's one.

    missing: samples before it that never came. unsent: those of them that the sender has not
    numbered. restarted: whether sender or clock has restarted, so that the plant state is unknown.
    """

    is_sample: bool = True
    missing: int = 0
    restarted: bool = False
    unsent: int = 0


NO_SAMPLE, NEXT_SAMPLE = Arrival(is_sample=False), Arrival()


class SampleCounter:
    """Counts samples both by message number and by stamp, and believes the larger count.

    Stamps also show samples that were never published, or lost by a relay that renumbers; a sender
    that keeps no time is counted by number alone unless it is late, one that has numbered a
    repetition by stamp alone for a while. index: of the newest sample, -1 before any. due_ns: when
    that was due. from_zero: whether the first index is the number of its message less 1, or 0; else
    it is its time in periods, so that a restart reuses no index.
    """

    def __init__(self, sample_period_s: float, from_zero: bool = True) -> None:
        self.index, self.due_ns = -1, 0.0
        self.sender = DriverPeriod(sample_period_s)
        self._from_zero = from_zero
        self._stamp_ns = self._sequence = 0  # of the newest sample
        self._repeated = 0  # number of the newest message that came too early to be a sample
        self._misnumbered = 0  # samples for which numbers are not believed any more than time
        self._early_ns = 0.0  # the earliest time at which the newest sample may have been due
        self._lateness_ns: deque[float] = deque(maxlen=20)  # of the newest samples, unshifted
        self._shifted_ns = 0.0  # by how much due_ns was shifted so far
        self._on_time = 0  # samples on time, minus twice the early ones, but at least 0
        self._strange = 0  # messages in a row that do not follow the newest sample

    def count(self, stamp_ns: int, sequence: int = UNNUMBERED, numbered: bool = True,
              received_ns: int = 0) -> Arrival:
        """Take in a message and return how it counts; the arguments are those of Output."""
        known = sequence != UNNUMBERED
        numbered = numbered and known
        self.sender.hear(stamp_ns, received_ns)
        self.sender.learn()
        period = self.sender.period_ns
        keeps_time = self._on_time >= 20  # then a message that is much too early is refused
        if self.index < 0:
            self.index = round(stamp_ns / period) if not self._from_zero \
                else max(sequence - 1, 0) if numbered else 0
            self._begin(stamp_ns, sequence)
            return NEXT_SAMPLE
        if stamp_ns < self._stamp_ns:
            return self._of_another(stamp_ns, sequence)
        late = (stamp_ns - self.due_ns) / period - 1.0  # [periods], may be negative
        is_early = stamp_ns < self._early_ns + 0.7 * period
        by_time = max(int(late + 1.0 - JITTER), 0)
        skipped = 0  # numbers between this message and the newest one of its sender
        if known:
            passed = self._repeated if self._repeated < sequence else self._sequence
            skipped = sequence - passed - 1
            if skipped < 0:
                silent = stamp_ns - self._stamp_ns > 3.0 * period
                if keeps_time and not silent:
                    return NO_SAMPLE
                # Two senders that alternate must not look like one that restarts all the time.
                return self._of_another(stamp_ns, sequence, by_time, silent and not keeps_time)
            if not numbered and is_early and skipped > 0:
                return NO_SAMPLE  # of another sender
            # Numbers may jump some samples further than time has passed.
            further = MISNUMBERED if self._misnumbered else 4.0
            if numbered and keeps_time and skipped > late + further:
                # A second sender, or a flood of which the middleware has dropped a part: wait a
                # while for a message that fits.
                if late < 1.5:
                    return NO_SAMPLE
                skipped = by_time
        if keeps_time and is_early:
            if skipped == 0:
                self._repeated, self._misnumbered = sequence, MISNUMBERED
            return NO_SAMPLE
        counts_samples = numbered and not (self._misnumbered and keeps_time)
        missing = max(by_time, skipped) if counts_samples else by_time
        if missing == 0 and not keeps_time:
            # An early one cancels two that were on time.
            self._on_time = max(self._on_time + (-2 if is_early else 1), 0)
            self.sender.came_early |= is_early
            if self.sender.came_early and self._on_time == 20:
                # It keeps time: the early ones were no samples, and the count so far is wrong.
                arrival = self._of_another(stamp_ns, sequence, at_once=True)
                self._on_time = 20
                return arrival
        self._sequence = self._repeated = sequence
        self._stamp_ns, self._strange = stamp_ns, 0
        self._misnumbered = max(self._misnumbered - 1, 0)
        self._follow_phase(stamp_ns, missing, 20 if self._on_time >= 20 else 6)
        self.sender.follow(stamp_ns)
        self.index += 1 + missing
        if not missing:
            return NEXT_SAMPLE
        return Arrival(missing=missing, unsent=max(missing - skipped, 0) if known else 0)

    def _follow_phase(self, stamp_ns: int, missing: int, window: int) -> None:
        period, latenesses = self.sender.period_ns, self._lateness_ns
        expected = self.due_ns + period * (1 + missing)
        late = stamp_ns - expected
        latenesses.append(late + self._shifted_ns)
        shift = min(late, period * CLOCK_SLACK)
        # If so many in a row all came later than expected, the sender has paused, and the least
        # lateness among them is its new phase.
        if shift > 0.0 and len(latenesses) >= window:
            shift = max(shift, min(islice(reversed(latenesses), window)) - self._shifted_ns)
        self._shifted_ns += shift
        self.due_ns = expected + shift
        # A sender that was held up for some samples returns to its old phase: this one lags behind.
        early = self._early_ns + period * (1 + missing + CLOCK_SLACK)
        self._early_ns = max(min(early, stamp_ns), self.due_ns - 0.5 * period)

    def _of_another(self, stamp_ns: int, sequence: int, missing: int = 0,
                    at_once: bool = False) -> Arrival:
        """Restart with another sender, or a clock that was set back, if seen for long enough."""
        self._strange += 1
        if self._strange < 5 and not at_once:
            return NO_SAMPLE
        self.index += 1 + missing
        self._begin(stamp_ns, sequence)
        return Arrival(missing=missing, restarted=True)

    def _begin(self, stamp_ns: int, sequence: int) -> None:
        self._sequence = self._repeated = sequence
        self.due_ns = self._early_ns = float(stamp_ns)
        self._stamp_ns = stamp_ns
        self._lateness_ns.clear()
        self.sender.restart(stamp_ns)
        self._on_time = self._strange = 0


def kept_outputs(sample_period: float) -> int:
    """Number of outputs that are kept for a controller that is held up, to learn from later."""
    return round(max(0.1 / sample_period, 20))


class ReferencePace:
    """Decides which sample of y_m is to be sent now, if any; all times are on a steady clock [s].

    y_m(k+1) leaves half a period after y(k) was due, or as soon as a late y(k) is there; without
    outputs the node's own clock sets the pace. At most one leaves per period, and no sample twice
    once the first output has come. waits: whether y_m(0) is repeated until then. own_clock: False
    on simulated time, which may run at any speed: then the newest y_m is repeated. due_s: when to
    look for an output, and to wait for one if there is none.
    """

    def __init__(self, period_s: float, waits: bool, now_s: float, own_clock: bool = True) -> None:
        self.waits, self._period_s, self._own_clock = waits, period_s, own_clock
        self._fresh = False  # an output that is not answered yet
        self._heard_s = -inf  # when the newest output came
        self._offset = 0  # sample of y_m that follows the newest output, minus the index of that
        self._next = 0  # sample that follows the newest output
        self._sent = -1
        self.due_s = now_s

    def hear(self, index: int, at_s: float) -> None:
        if self._heard_s == -inf:
            self._offset = 1 if self.waits else self._next - index
        # If the own clock has run ahead, y_m does not go back.
        self._offset = max(self._offset, self._sent - index)
        self._next = index + self._offset
        self._fresh, self._heard_s, self.waits = True, at_s, False

    def sample_to_send(self, now_s: float) -> int | None:
        """Return the sample whose y_m is to leave now, or None if it is not time yet."""
        period, sample = self._period_s, self._next
        if now_s < self.due_s:
            return None
        if self._heard_s == -inf:
            # Messages that were due while the process was held up are not made up for.
            self.due_s = max(self.due_s, now_s - 0.5 * period) + period
            self._next += not self.waits
            self._sent = sample
            return sample
        if self._fresh:
            self._fresh = False
            self.due_s = self._heard_s + 1.5 * period
        elif now_s < self._heard_s + (1.0 + JITTER) * period:
            return None  # an output that has not come yet does not count as lost
        elif not self._own_clock:
            self.due_s = now_s + period
            return sample
        else:
            missing = max(int((now_s - self._heard_s) / period - JITTER), 1)
            self.due_s = self._heard_s + (1 + missing + JITTER) * period
            sample += missing
        if sample <= self._sent:
            return None
        self._sent, self.due_s = sample, max(self.due_s, now_s + 0.5 * period)
        return sample
