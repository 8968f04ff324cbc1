"""What is known of one controller: its newest diagnostics and estimates, what has happened."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, nan

from backlash_ros.nodes.runtime.messages import SILENT_S
from backlash_ros.topics import BACKLASH

DIGITS = re.compile(r'[\d.]+')  # a text in which a figure has changed tells nothing new


@dataclass
class ControllerState:
    """One controller, or a joint of it. node: its name, with namespace. level: of /diagnostics.

    values: of /diagnostics, as they stand there. estimates: value and half width of its band of
    two deviations (nan where there are none). scales: the largest magnitudes that were shown.
    events: time of day and text, the newest one last.
    """

    node: str
    joint: str = ''
    level: int = 0
    message: str = ''
    heard_at_s: float = -inf  # on the steady clock
    values: dict[str, str] = field(default_factory=dict)
    estimates: dict[str, tuple[float, float]] = field(
        default_factory=lambda: dict.fromkeys(BACKLASH, (nan, nan))
    )
    scales: dict[str, float] = field(default_factory=lambda: dict.fromkeys(BACKLASH, 0.0))
    events: deque[tuple[str, str]] = field(default_factory=lambda: deque(maxlen=20))

    @property
    def name(self) -> str:
        """As /diagnostics calls it."""
        return f'{self.node}: {self.joint}' if self.joint else self.node

    def take_diagnostics(
        self, level: int, message: str, values: Mapping[str, str], now_s: float, clock: str,
    ) -> None:
        """Take in a status; a text that has changed is an event. clock: the time of day."""
        if DIGITS.sub('', message) != DIGITS.sub('', self.message):
            self.note(clock, message)
        self.level, self.message, self.heard_at_s = level, message, now_s
        self.values = dict(values)
        for name in BACKLASH:
            self.take_estimate(name, self.number(name), 2.0 * self.number(f'std_{name}'))

    def take_estimate(self, name: str, value: float, half_width: float | None = None) -> None:
        """Take in m, c_r or c_l; half_width: of its band, None where that is as before."""
        if half_width is None:
            _, half_width = self.estimates[name]
        self.estimates[name] = (value, half_width)
        if isfinite(value):
            self.scales[name] = max(self.scales[name], abs(value))

    def note(self, clock: str, text: str) -> None:
        """Remember what has happened."""
        self.events.append((clock, text))

    def number(self, key: str) -> float:
        """A value of the diagnostics, nan where it is missing or no number."""
        try:
            return float(self.values.get(key, ''))
        except ValueError:
            return nan

    def is_on(self, key: str) -> bool:
        """A switch in the diagnostics."""
        return self.values.get(key) == 'True'

    def silent_s(self, now_s: float) -> float:
        """How long nothing was heard of it, 0 as long as that means nothing."""
        passed = now_s - self.heard_at_s
        return passed if SILENT_S < passed < inf else 0.0

    def word(self, now_s: float) -> str:
        """Its state in a word or two."""
        if not self.message:
            return 'no diagnostics yet'
        if silent_s := self.silent_s(now_s):
            return f'silent for {silent_s:.0f} s'
        # An unconfigured or inactive controller has no state of the estimates to tell.
        return self.values.get('state') or self.message.partition(':')[0]
