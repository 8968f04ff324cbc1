"""Where the reports of the driver have their zero: a motor encoder may not have been zeroed."""

from __future__ import annotations

from collections import deque
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate

Array = NDArray[np.float64]

LOOKS = 10  # that tell the origin, after which it counts as settled


class ReportOrigin:
    """Finds the constant between the v that is reported and the command that it stands for.

    The motor follows its command v with a first-order lag, p = 0 where it takes it over at once:

        r(k) - b = p (r(k-1) - b) + (1 - p) v(k)

    which is a straight line of r(k) - v(k) over r(k-1) - v(k). A motor that rests, or does not
    follow because it is saturated, has p = 1 and tells nothing. What is left of the line has to be
    small beside b: a driver that limits v to one side has no other origin.

    value: b, 0 until another one is certain. before: what was known at the first report.
    """

    def __init__(self) -> None:
        self.value = 0.0
        self.before: Estimate | None = None
        self.restart()

    def restart(self) -> None:
        """Look again: the driver was restarted, and its encoder perhaps zeroed."""
        self._looks = 0
        self._pairs: deque[tuple[float, float]] = deque(maxlen=201)
        self._new = 0  # pairs since the last look

    def changed_by(
        self, report: float, command: float, known: Estimate | None = None,
    ) -> bool:
        """Take in what was reported of an interval and commanded in it; whether `value` changed.

        known: at present. What was learned beside another origin is void.
        """
        look_after, correlated, significant = 20, 10.0, 5.0  # intervals, intervals, deviations
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
        off = abs(found - self.value)
        std = sqrt(correlated * rest / len(x) + (p_std * (x_mean - found)) ** 2) / (1.0 - p)
        if off <= significant * max(std, sqrt(rest)) + rounding:
            return False
        self.value, self._looks = found, LOOKS
        return True


def without_origin(reports: Array, commands: Array) -> Array:
    """Reports of a record as they would be from an encoder that was zeroed; nan where none is."""
    origin = ReportOrigin()
    for report, command in zip(reports.tolist(), commands.tolist(), strict=True):
        if report == report and command == command:
            origin.changed_by(report, command)
    return reports - origin.value
