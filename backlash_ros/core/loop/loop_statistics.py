"""Counts and statistics of a control loop."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, nan, pi

import numpy as np


@dataclass
class Counts:
    """Numbers of samples and messages, since a loop began or within the last seconds."""

    without_reference: int = 0  # outputs before the first y_m
    bad_outputs: int = 0  # values of y that are not plausible: nan, infinite or absurdly large
    bad_references: int = 0  # ... and of y_m
    bad_reports: int = 0  # ... and of applied_control
    extra: int = 0  # outputs that were repeated, too early, old or of a second driver
    used: int = 0  # outputs that were answered with a command
    lost: int = 0  # outputs that never arrived
    unsent: int = 0  # of these, the ones that the driver never published
    late: int = 0  # commands that missed their sample
    unreported: int = 0  # outputs without a matching report while reports are used
    interruptions: int = 0  # times that the driver was silent or restarted
    limited: int = 0  # commands that met a limit

    @property
    def dropped(self) -> int:
        """Messages without a plausible value."""
        return self.bad_outputs + self.bad_references + self.bad_reports

    @property
    def heard(self) -> int:
        """Samples that have arrived, whether usable or not."""
        return self.used + self.without_reference + self.bad_outputs


@dataclass
class LoopStatistics(Counts):
    """Counts since the loop began, and figures of how well it runs now.

    wraps: times that y jumped by 2 pi. still: newest values of y in a row that are equal within
    still_band; still_v: lowest and highest v meanwhile. v_range: the same since `swing` was called.
    inconsistent: newest samples in a row that contradict the estimate. latencies [s]: the newest
    ones, as topics.py defines them.
    """

    wraps: int = 0
    still_band: float = 0.0
    still: int = 0
    still_v: tuple[float, float] = (inf, -inf)
    v_range: tuple[float, float] = (inf, -inf)
    inconsistent: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=1000))
    _y: float = nan  # the first of the newest equal values
    _y_before: float = nan
    _pace: float = inf  # how far y usually moves from sample to sample

    @property
    def still_swing(self) -> float:
        """How far v has moved while y stands still."""
        return max(self.still_v[1] - self.still_v[0], 0.0)

    def note(self, y: float, v: float, limited: bool, inconsistent: bool, latency: float) -> None:
        """Count an output and the command that answered it."""
        self.used += 1
        self.limited += limited
        self.inconsistent = self.inconsistent + 1 if inconsistent else 0
        self.latencies.append(latency)
        self.v_range = _with(v, self.v_range)
        moved = abs(y - self._y_before)
        # A jump by about a turn, and much further than y usually moves.
        if abs(moved - 2.0 * pi) < 0.3 and moved > 10.0 * self._pace:
            self.wraps += 1
        elif moved == moved:
            self._pace = moved if self._pace == inf else self._pace + 0.05 * (moved - self._pace)
        self._y_before = y
        if not abs(y - self._y) <= self.still_band:
            self._y, self.still, self.still_v = y, 0, (v, v)
        self.still, self.still_v = self.still + 1, _with(v, self.still_v)

    def latencies_ms(self, *shares: float) -> list[float]:
        """Return these quantiles of the latest latencies [ms]; nan without any."""
        return [1e3 * float(each) for each in np.quantile(self.latencies or [nan], shares)]

    def swing(self) -> float:
        """Return highest minus lowest v since the last call."""
        (low, high), self.v_range = self.v_range, (inf, -inf)
        return max(high - low, 0.0)


def _with(value: float, bounds: tuple[float, float]) -> tuple[float, float]:
    return min(value, bounds[0]), max(value, bounds[1])


class Lately:
    """Increments of counters within the last three seconds, or a little more."""

    def __init__(self) -> None:
        self._looks: deque[tuple[float, Mapping[str, int]]] = deque()

    def gained(self, counts: Mapping[str, int], now_s: float) -> dict[str, int]:
        """Take in the counters as they are now [s], and return the latest increment of each.

        Counters that have decreased belong to a new loop, which began with 0.
        """
        looks = self._looks
        if looks and any(counts[name] < n for name, n in looks[-1][1].items()):
            looks.clear()
        while len(looks) > 1 and looks[1][0] <= now_s - 3.0:
            looks.popleft()
        before = looks[0][1] if looks else {}
        looks.append((now_s, counts))
        return {name: count - before.get(name, 0) for name, count in counts.items()}
