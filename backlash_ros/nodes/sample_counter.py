"""Which sample of the plant a message holds, and how many were skipped before it."""

from __future__ import annotations

# What the middleware reports where it does not number messages.
UNNUMBERED = 2**64 - 1
# A stamp never comes before its sample, so a missing one shows as a full period of lateness.
# Jitter of the sender up to this share of a period is not taken for a loss.
JITTER = 0.85
# Share of a period by which the sender's clock may run slow per sample.
CLOCK_SLACK = 0.01


class SampleCounter:
    """Counts samples by two witnesses: sequence numbers and time stamps.

    Sequence numbers tell what the middleware lost; they cannot tell what was never published, or
    what a relay that numbers anew has lost. Time stamps can: sample k is due one period after
    sample k-1. The larger count is believed.

    index: of the newest sample, -1 before the first. Where messages are numbered, it is the count
    of the sender, which begins with 1.
    """

    def __init__(self, sample_period_s: float) -> None:
        self.index = -1
        self._period_ns = sample_period_s * 1e9
        self._sequence = 0
        self._due_ns = 0.0  # when the newest sample was due at the sender

    def count(self, stamp_ns: int, sequence: int = UNNUMBERED) -> int:
        """Take in a message; return how many samples are missing since the one before."""
        numbered = sequence != UNNUMBERED
        if self.index < 0:
            self.index = max(sequence - 1, 0) if numbered else 0
            self._sequence, self._due_ns = sequence, float(stamp_ns)
            return 0
        period = self._period_ns
        due = self._due_ns + period
        by_time = int((stamp_ns - due) / period + 1.0 - JITTER) if stamp_ns > due else 0
        # A sender that was started anew begins with 1 again.
        by_number = sequence - self._sequence - 1 if numbered and sequence > self._sequence else 0
        missing = max(by_time, by_number)
        self._sequence = sequence
        self._due_ns = min(due + period * (missing + CLOCK_SLACK), float(stamp_ns))
        self.index += 1 + missing
        return missing
