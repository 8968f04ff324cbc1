"""The hand-over: whoever takes over v, and whatever it takes it over with, v does not jump.

Controllers restart, a rival leaves, gains of a better G or of other weights and other estimates
take over: each time what v stands for differs from what is asked for from now on. This is added to
u_d, and fades.
"""

from __future__ import annotations

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.tracking.trust import TrustState

FADING = 0.8  # per sample, of what is handed over


class HandOver:
    """Adds to u_d what it has been handed over.

    leading: whether the reference may have gone on while nobody followed it.
    """

    def __init__(self) -> None:
        self._offset = 0.0  # added to the next u_d
        self._widens = False  # whether it may lead u_d further than feedback may
        self._u_d = 0.0  # of the sample before
        self._stays = False  # whether v stays where it is at the next sample
        self.leading = False

    def from_rest(self, leading: bool) -> None:
        """Let v stay where it is for a sample, and go on from there.

        leading: see above.
        """
        self._stays, self.leading, self._offset = True, leading, 0.0
        self._widens = leading

    def from_u_d(self, u_d: float) -> None:
        """Go on from the u_d of the sample before; u_d: what takes over would have asked for."""
        self._offset, self._widens = FADING * (self._u_d - u_d), True

    def to_estimate(self, inverse: BacklashInverse, trust: TrustState) -> None:
        """Go on with another estimate, by which v stands for another u."""
        before = inverse.extreme
        self._offset += FADING * (inverse.resume(trust.slope, *trust.crossings) - before)

    def apply(
        self, u_d: float, inverse: BacklashInverse, trust: TrustState,
    ) -> tuple[float, float]:
        """Return u_d with what is handed over, and by how much that may lead it further out.

        What only another estimate makes of v leads u_d no further than feedback may.
        """
        if self._stays:
            self._offset = inverse.resume(trust.slope, *trust.crossings) - u_d
            self._stays = self.leading = False
        added, self._offset = self._offset, FADING * self._offset
        return u_d + added, abs(added) if self._widens else 0.0

    def note(self, u_d: float) -> None:
        """Note the u_d that was used."""
        self._u_d = u_d
