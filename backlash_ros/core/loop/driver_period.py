"""When a driver really samples, from the stamps of its messages."""

from __future__ import annotations

from collections import deque
from itertools import islice, pairwise
from math import isfinite, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Share by which a period has to be off to be taken for another one than that of the model.
OTHER_PERIOD = 0.003


class Period(NamedTuple):
    """Mean period of the driver, its standard deviation, the median interval [s]; nan: not known.

    scatter: standard deviation of the stamps around their even spacing [s].
    """

    mean: float = nan
    std: float = nan
    median: float = nan
    scatter: float = nan

    def differs_from(self, nominal_s: float, tolerance: float) -> bool:
        """Whether it certainly is off by more than a share, and the median interval likewise."""
        off = self.mean - nominal_s
        return abs(off) > tolerance * nominal_s + 3.0 * self.std \
            and (self.median - nominal_s) * off > 0.5 * tolerance * nominal_s * abs(off)


class Timing(NamedTuple):
    """What is known of when y comes; what is not known is nan.

    nominal_s: the period of the model. intervals_s: low, mean and high of the newest ones between
    messages, of which a tenth is shorter and a tenth longer. age_s: median time from stamp to
    arrival, negative where the clock of the driver is ahead. repeats_stamps: whether it sends some
    of them twice.
    """

    nominal_s: float
    period: Period = Period()
    intervals_s: tuple[float, float, float] = (nan, nan, nan)
    age_s: float = nan
    repeats_stamps: bool = False

    @property
    def is_stretched(self) -> bool:
        """Whether pauses make the period longer, as the median interval is not."""
        mean, std, *_ = self.period
        return mean - self.nominal_s > 0.01 * self.nominal_s + 3.0 * std \
            and not self.period.differs_from(self.nominal_s, 0.01)

    @property
    def rate(self) -> float:
        """The rate of y [Hz] where it is not that of the model, else nan.

        Losses and stalls lengthen some of the intervals, messages sent twice shorten some: where
        the period is not known, the rate is wrong only if nearly all intervals are off to the same
        side by a tenth.
        """
        # From 0.5 % on, less what is not known of the period after a second.
        if self.period.differs_from(self.nominal_s, 0.0045) or self.is_stretched:
            return 1.0 / self.period.mean
        low, mean, high = self.intervals_s
        off = low > 1.1 * self.nominal_s or high < self.nominal_s / 1.1
        return 1.0 / mean if off and mean > 0.0 else nan


class DriverPeriod:
    """Learns the period of a driver from the stamps of its samples [ns].

    period_ns: that to count with, nominal_s where no other one is certain.
    """

    def __init__(self, nominal_s: float) -> None:
        self.nominal_s, self.period_ns = nominal_s, 1e9 * nominal_s
        self._samples_ns: deque[int] = deque(maxlen=1000)
        self._messages_ns: deque[int] = deque(maxlen=51)
        self._ages_s: deque[float] = deque(maxlen=50)
        self._since_learned = 0  # samples

    def hear(self, stamp_ns: int, received_ns: int) -> None:
        """Take in any message of y: when it left and when it came, 0 where nobody tells."""
        self._messages_ns.append(stamp_ns)
        if received_ns > 0:
            self._ages_s.append((received_ns - stamp_ns) * 1e-9)

    def follow(self, stamp_ns: int) -> None:
        """Take in the stamp of the next sample."""
        self._samples_ns.append(stamp_ns)
        self._since_learned += 1

    def restart(self, stamp_ns: int) -> None:
        """Begin anew with this sample: the clock of the stamps is another one."""
        self._samples_ns.clear()
        self._samples_ns.append(stamp_ns)
        self._since_learned, self.period_ns = 0, 1e9 * self.nominal_s

    def learn(self) -> None:
        """Learn the period to count with, if it is time: for whenever nothing waits for it."""
        if self._since_learned < 20:
            return
        self._since_learned = 0
        nominal_s, stamps, intervals = self.nominal_s, self._samples_ns, 50
        is_other = self.period_ns != 1e9 * nominal_s
        if not is_other and len(stamps) > intervals:
            periods = (stamps[-1] - stamps[-1 - intervals]) / self.period_ns
            if abs(periods - intervals) < OTHER_PERIOD * intervals:
                return  # as nearly always: what follows takes as long as a command
        found = self.newest(intervals)
        # Once another one was certain, what is likely suffices.
        if isfinite(found.mean) and (is_other or found.differs_from(nominal_s, OTHER_PERIOD)):
            off = abs(found.mean - nominal_s) > OTHER_PERIOD * nominal_s
            self.period_ns = 1e9 * (found.mean if off else nominal_s)

    def timing(self) -> Timing:
        """All that is known now."""
        intervals = sorted(later - earlier for earlier, later in pairwise(self._messages_ns))
        low = mean = high = nan
        if len(intervals) >= 20:
            tenth = len(intervals) // 10
            low, high = 1e-9 * intervals[tenth], 1e-9 * intervals[-1 - tenth]
            mean = 1e-9 * sum(intervals) / len(intervals)
        age_s = float(np.median(self._ages_s)) if len(self._ages_s) >= 20 else nan
        return Timing(self.nominal_s, self.newest(), (low, mean, high), age_s)

    def newest(self, intervals: int = 1000) -> Period:
        """The period over so many intervals at most: the slope of the stamps over their samples.

        It is known to some 0.1 % after a second. A message that was lost, or came twice, does not
        disturb it; unknown where most intervals are no period at all, or scatter widely.
        """
        stamps = list(islice(reversed(self._samples_ns), intervals + 1))[::-1]
        if len(stamps) <= 20:
            return Period()
        times = 1e-9 * np.array([stamp - stamps[-1] for stamp in stamps])
        # Those of 2 s, 20 intervals at least.
        times = times[min(int(np.count_nonzero(times < -2.0)), len(times) - 21):]
        ordered, nominal_s = np.sort(np.diff(times)), self.nominal_s
        quarter = len(ordered) // 4
        typical = float(ordered[quarter:-quarter].mean())
        if not abs(typical / nominal_s - 1.0) < 0.25:
            return Period()
        apart = 1 + len(times) // 300  # neighbours tell the same
        times = times[::apart]
        found = _slope(np.array(_numbered(times.tolist(), typical)), times, apart)
        # Beyond such a scatter, as of a driver that is held up all the time, nobody can tell from
        # the stamps which samples were left out.
        if not (found.mean > 0.0 and found.scatter < 0.2 * nominal_s):
            return Period()
        return found._replace(median=float(ordered[len(ordered) // 2]))


def _numbered(times: list[float], period_s: float) -> list[float]:
    """The number of each sample: stamps come late, by less than a period, but hardly early."""
    number, numbers, due = 0.0, [0.0], times[0]
    for time in times[1:]:
        passed = max(int((time - due) / period_s + 0.3), 0)
        number += passed
        numbers.append(number)
        late = time - due - passed * period_s
        due += passed * period_s + min(late, 0.01 * period_s)
    return numbers


def _slope(numbers: Array, times: Array, apart: int) -> Period:
    """The straight line through the times of samples, of which every apart-th is here."""
    n, t = numbers - numbers.mean(), times - times.mean()
    spread = float(n @ n)
    if not spread:
        return Period()
    slope = float(n @ t) / spread
    rest = float(np.mean((t - slope * n) ** 2))
    # A process that is held up is late for some ten samples, whose lateness is one error.
    return Period(slope, sqrt(max(10.0 / apart, 1.0) * rest / spread), scatter=sqrt(rest))
