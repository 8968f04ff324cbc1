"""What is said of a node, in /diagnostics and, once, in the log."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from math import inf
from typing import NamedTuple

# What passes by itself as a rule is told only after so long: at the third of the looks, which come
# once a second, be it a little early.
LASTS_S = 1.5
AGAIN_S = 10.0  # until the same cause is told once more


class Level(IntEnum):
    """How bad it is, in the numbers of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Finding(NamedTuple):
    """One line of what goes on. kind: the same word for the same cause, whatever its figures.

    lasting: worth a line of the log only once it has lasted, as it passes by itself as a rule.
    """

    level: Level
    kind: str
    text: str
    lasting: bool = False


class LevelLog:
    """Writes one line when the level or the cause changes, and one when all is well again.

    What comes and goes is told once: that it is well again only after it has been so for LASTS_S,
    and the same cause again only after AGAIN_S.
    """

    def __init__(self, write: Callable[[Level, str], None]) -> None:
        self._write = write
        self._told: tuple[Level, str] | None = None  # the newest line, None if all is well
        self._told_at: dict[tuple[Level, str], float] = {}  # [s]
        self._seen, self._seen_since = (Level.OK, ''), -inf

    def take(self, finding: Finding, now_s: float) -> None:
        """Take in what is published in /diagnostics now."""
        key = (finding.level, finding.kind if finding.level != Level.OK else '')
        if key != self._seen:
            self._seen, self._seen_since = key, now_s
        lasted = now_s - self._seen_since >= LASTS_S
        if finding.level == Level.OK:
            if self._told is not None and lasted:
                self._told = None
                self._write(Level.OK, f'well again: {finding.text}')
        elif (lasted or not finding.lasting) and key != self._told \
                and now_s >= self._told_at.get(key, -inf) + AGAIN_S:
            self._told, self._told_at[key] = key, now_s
            self._write(finding.level, finding.text)
