"""The period at which a driver really samples, from the stamps of its samples."""

from __future__ import annotations

from collections import deque
from math import nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEWEST = 20  # intervals
# What the period is fitted to: the newest stamps of this time, and at most so many.
WINDOW_S, STAMPS = 2.0, 1000
OTHER_PACE = 0.25  # share by which typical intervals differ from the period where they are no such
# Share of the period by which stamps may scatter: beyond, as of a driver that is held up all the
# time, nobody can tell from them which samples were left out.
SCATTERED = 0.2
# Shares of the period: by which a stamp may come early, and by which its phase follows a late one.
EARLY, SLACK = 0.3, 0.01
# Samples for which a process that is held up is late, so that their lateness is one error.
HELD_UP = 10.0


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
    """Learns the period of a driver from the stamps of its samples [ns]."""

    def __init__(self, nominal_s: float) -> None:
        self.nominal_s = nominal_s
        self._stamps_ns: deque[int] = deque(maxlen=STAMPS)

    def note(self, stamp_ns: int) -> None:
        """Take in the stamp of a sample."""
        self._stamps_ns.append(stamp_ns)

    def restart(self) -> None:
        """Forget what was before: the clock of the stamps is another one."""
        self._stamps_ns.clear()

    def newest(self, intervals: int = STAMPS) -> Period:
        """The period over so many intervals at most: the slope of the stamps over their samples.

        It is known to some 0.1 % after a second. A message that was lost, or came twice, does not
        disturb it; unknown where most intervals are no period at all, or scatter widely.
        """
        stamps = list(self._stamps_ns)[-intervals - 1:]
        begin = len(stamps) - FEWEST - 1
        if begin < 0:
            return UNKNOWN_PERIOD
        times = 1e-9 * np.array([float(stamp - stamps[-1]) for stamp in stamps])
        early = np.flatnonzero(times[:begin] < -WINDOW_S)
        times = times[early[-1] + 1 if len(early) else 0:]
        steps = np.diff(times)
        ordered = np.sort(steps)
        quarter = len(ordered) // 4
        typical = float(ordered[quarter:-quarter].mean())
        if not abs(typical / self.nominal_s - 1.0) < OTHER_PACE:
            return UNKNOWN_PERIOD
        found = _slope(np.append(0.0, np.rint(steps / self.nominal_s)).cumsum(), times)
        if found.mean > 0.0:
            found = _slope(np.array(_numbered(times.tolist(), found.mean), float), times)
        if not (found.mean > 0.0 and found.scatter < SCATTERED * self.nominal_s):
            return UNKNOWN_PERIOD
        return found._replace(median=float(np.median(ordered)))


def _numbered(times: list[float], period_s: float) -> list[int]:
    """The number of each sample: stamps come late, by less than a period, but hardly early."""
    numbers, due = [0], times[0]
    for time in times[1:]:
        passed = max(int((time - due) / period_s + EARLY), 0)
        numbers.append(numbers[-1] + passed)
        late = time - due - passed * period_s
        due += passed * period_s + min(late, SLACK * period_s)
    return numbers


def _slope(numbers: Array, times: Array) -> Period:
    n, t = numbers - numbers.mean(), times - times.mean()
    spread = float(n @ n)
    if not spread:
        return UNKNOWN_PERIOD
    slope = float(n @ t) / spread
    rest = float(np.mean((t - slope * n)**2))
    return Period(slope, sqrt(HELD_UP * rest / spread), scatter=sqrt(rest))
