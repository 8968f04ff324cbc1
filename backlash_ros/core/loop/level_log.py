"""Which diagnostics become a line of the log: changes of the level, each cause once."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

from backlash_ros.core.loop.figures import Finding, Level

# What passes by itself as a rule is told only after so long: at the third of the looks, which come
# once a second, be it a little early.
LASTS_S = 1.5
AGAIN_S = 10.0  # until the same cause is told once more


class LevelLog:
    """Writes one line when the level or the cause changes, and one when all is well again.

    What comes and goes is told once: that it is well again only after it has been so for LASTS_S,
    and the same cause again only after AGAIN_S.
    """

    def __init__(self, write: Callable[[Level, str], None]) -> None:
        self._write = write
        self._told: Finding | None = None  # the trouble of the newest line, None if all is well
        self._told_at: dict[tuple[Level, str], float] = {}  # [s]
        self._seen, self._seen_since = ('', Level.OK), -inf

    def take(self, finding: Finding, now_s: float) -> None:
        """Take in what is published in /diagnostics now."""
        seen = (finding.kind if finding.level != Level.OK else '', finding.level)
        if seen != self._seen:
            self._seen, self._seen_since = seen, now_s
        lasted = now_s - self._seen_since >= LASTS_S
        if finding.level == Level.OK:
            if self._told is not None and lasted:
                self._told = None
                self._write(Level.OK, f'well again: {finding.text}')
            return
        told, key = self._told, (finding.level, finding.kind)
        if (finding.lasting and not lasted) \
                or (told is not None and (told.level, told.kind) == key) \
                or now_s < self._told_at.get(key, -inf) + AGAIN_S:
            return
        self._told, self._told_at[key] = finding, now_s
        self._write(finding.level, finding.text)
