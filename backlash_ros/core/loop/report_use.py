"""Whether the v that a driver reports on applied_control is learned from, not the own command."""

from __future__ import annotations

from enum import Enum

from backlash_ros.core.parameters import Parameters

# Outputs in a row with a report for each of their intervals after which reports are believed, and
# without, after which they are given up. Messages that have nothing to do with the samples fit an
# interval every other time at most: 20 times in a row by a chance of one in a million.
CONSISTENT = 20
# Outputs that stay without an answer while the driver may yet report its v, and for how long.
AWAITED_REPORTS, AWAITED_S = 20, 0.5


class ReportUse(Enum):
    """Whether the v that the driver reports goes before the own command."""

    NEVER = 'false'
    AUTO = 'auto'
    ALWAYS = 'true'


def report_use(p: Parameters) -> ReportUse:
    """What estimator.use_applied_control comes to.

    With control.delay_samples a driver may report v before or after that delay: auto leaves it
    alone then. In lockstep every v is applied at once.
    """
    use = ReportUse(p.estimator.use_applied_control)
    delayed = use is ReportUse.AUTO and p.control.delay_samples > 0
    return ReportUse.NEVER if delayed or p.lockstep else use


def awaited_reports(p: Parameters) -> int:
    """How many outputs may stay without an answer while the driver may yet report its v."""
    return min(AWAITED_REPORTS, max(int(AWAITED_S / p.sample_period), 1))


class ReportTrust:
    """Whether reports are used at present: always, never, or as long as none is missing."""

    def __init__(self, use: ReportUse) -> None:
        self.trusted = use is ReportUse.ALWAYS
        self._use = use
        self._contrary = 0  # outputs in a row that speak against `trusted`

    def note(self, complete: bool) -> bool:
        """Note whether each interval before an output had its report; returns `trusted`."""
        self._contrary = 0 if complete is self.trusted else self._contrary + 1
        if self._use is ReportUse.AUTO and self._contrary == CONSISTENT:
            self.trusted, self._contrary = complete, 0
        return self.trusted
