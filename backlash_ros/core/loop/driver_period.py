"""The period at which a driver really samples, from the stamps of its samples."""

from __future__ import annotations

from collections import deque
from itertools import islice
from math import isfinite, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STAMPS = 1000  # the newest ones, to which the period is fitted, within 2 s
# The period that is counted with is learned anew after so many intervals. It is taken for another
# one than that of the samples where it is off by more than this share.
LEARN_PERIOD_AFTER, OTHER_PERIOD = 20, 0.003


class Period(NamedTuple):
    """Mean period of the driver, its standard deviation, the median interval [s].

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

    def is_stretched(self, nominal_s: float, tolerance: float) -> bool:
        """Whether it certainly is longer by more than a share though the median interval is not."""
        return self.mean - nominal_s > tolerance * nominal_s + 3.0 * self.std \
            and not self.differs_from(nominal_s, tolerance)


UNKNOWN_PERIOD = Period()


class DriverPeriod:
    """Learns the period of a driver from the stamps of its samples [ns].

    period_ns: that to count with, nominal_s where no other one is certain.
    """

    def __init__(self, nominal_s: float) -> None:
        self.nominal_s, self.period_ns = nominal_s, 1e9 * nominal_s
        self._stamps_ns: deque[int] = deque(maxlen=STAMPS)
        self._since_learned = 0  # samples

    def follow(self, stamp_ns: int) -> None:
        """Take in the stamp of the next sample."""
        self._stamps_ns.append(stamp_ns)
        self._since_learned += 1

    def learn(self) -> None:
        """Learn the period to count with, if it is time: for whenever nothing waits for it."""
        if self._since_learned < LEARN_PERIOD_AFTER:
            return
        self._since_learned = 0
        nominal_s, stamps, intervals = self.nominal_s, self._stamps_ns, 50
        if self.period_ns == 1e9 * nominal_s and len(stamps) > intervals:
            periods = (stamps[-1] - stamps[-1 - intervals]) / self.period_ns
            if abs(periods - intervals) < OTHER_PERIOD * intervals:
                return  # as nearly always: what follows takes as long as a command
        found = self.newest(intervals)
        if found.differs_from(nominal_s, OTHER_PERIOD):
            self.period_ns = 1e9 * found.mean
        elif self.period_ns != 1e9 * nominal_s and isfinite(found.mean):
            # Once it was certain, what is likely suffices.
            off = abs(found.mean - nominal_s) > OTHER_PERIOD * nominal_s
            self.period_ns = 1e9 * (found.mean if off else nominal_s)

    def restart(self, stamp_ns: int) -> None:
        """Begin anew with this sample: the clock of the stamps is another one."""
        self._stamps_ns.clear()
        self._stamps_ns.append(stamp_ns)
        self._since_learned, self.period_ns = 0, 1e9 * self.nominal_s

    def newest(self, intervals: int = STAMPS) -> Period:
        """The period over so many intervals at most: the slope of the stamps over their samples.

        It is known to some 0.1 % after a second. A message that was lost, or came twice, does not
        disturb it; unknown where most intervals are no period at all, or scatter widely.
        """
        stamps = list(islice(reversed(self._stamps_ns), intervals + 1))[::-1]
        if len(stamps) <= 20:
            return UNKNOWN_PERIOD
        times = 1e-9 * np.array([stamp - stamps[-1] for stamp in stamps])
        # 20 intervals at least.
        times = times[min(int(np.count_nonzero(times < -2.0)), len(times) - 21):]
        steps, nominal_s = np.diff(times), self.nominal_s
        ordered, quarter = np.sort(steps), len(steps) // 4
        typical = float(ordered[quarter:-quarter].mean())
        if not abs(typical / nominal_s - 1.0) < 0.25:
            return UNKNOWN_PERIOD
        found = _slope(np.append(0.0, np.cumsum(np.round(steps / nominal_s))), times, 1)
        if found.mean > 0.0:
            # Neighbours tell the same.
            apart = 1 + len(times) // 300
            times = times[::apart]
            found = _slope(np.array(_numbered(times.tolist(), found.mean)), times, apart)
        # Beyond such a scatter, as of a driver that is held up all the time, nobody can tell from
        # the stamps which samples were left out.
        if not (found.mean > 0.0 and found.scatter < 0.2 * nominal_s):
            return UNKNOWN_PERIOD
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
        return UNKNOWN_PERIOD
    slope = float(n @ t) / spread
    rest = float(np.mean((t - slope * n) ** 2))
    # A process that is held up is late for some ten samples, whose lateness is one error.
    return Period(slope, sqrt(max(10.0 / apart, 1.0) * rest / spread), scatter=sqrt(rest))
