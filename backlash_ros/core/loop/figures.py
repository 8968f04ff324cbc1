"""What is known of a running loop, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from math import nan
from typing import NamedTuple

from backlash_ros.core.estimate import Status
from backlash_ros.core.law import LawReport
from backlash_ros.core.loop.driver_period import UNKNOWN_PERIOD, Period


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


# Kinds of findings about the messages, which are the same for all joints of a controller.
OF_MESSAGES = frozenset((
    'control type', 'control qos', 'rivals', 'second driver', 'second reference', 'unheard', 'rate',
    'stamps', 'clock', 'late', 'unsent', 'lost', 'unreported', 'reference silent', 'worker',
))


class Peer(NamedTuple):
    """Another publisher or subscriber of a topic; unfit: why no message passes, empty if it does.

    kind: its message type without the package. unfit is one of '', 'type', 'reliability', 'qos'.
    """

    name: str
    kind: str
    unfit: str = ''


@dataclass(frozen=True)
class TopicFigures:
    """A topic of the loop: its name, the wanted type without the package, who else is on it."""

    name: str
    kind: str = 'Float64'
    peers: tuple[Peer, ...] = ()

    @property
    def heard(self) -> list[Peer]:
        """Those whose messages pass."""
        return [peer for peer in self.peers if not peer.unfit]


@dataclass(frozen=True)
class LoopFigures:
    """What the controller knows of the last few seconds; counts are samples or messages.

    output, reference: with those who publish it. control: with those who receive it; rivals: who
    else publishes it. intervals_s: those between messages of y, low, mean and high, of which a
    tenth is shorter and longer [s], nan while they are not known. period: of the driver, by its
    stamps. repeats_stamps: whether it sends some of them twice. still: newest values of y in a row
    that are equal within its noise. v_swing: how far v has moved meanwhile, and gap, nan while it
    is not learned [unit of v]. wraps: jumps of y by a turn.
    """

    sample_period: float
    output: TopicFigures = field(default_factory=lambda: TopicFigures('plant_output'))
    reference: TopicFigures = field(default_factory=lambda: TopicFigures('reference'))
    control: TopicFigures = field(default_factory=lambda: TopicFigures('control'))
    rivals: tuple[str, ...] = ()
    standing_down: bool = False  # because of them
    status: Status | None = None  # None before the first command
    inconsistent_s: float = 0.0  # how long that status has been INCONSISTENT
    law: LawReport = field(default_factory=LawReport)
    adapting: bool = True
    given: bool = False  # whether the estimates are taken as the parameters give them
    silent_s: float = 0.0  # timeout that has passed without y, 0 if it has not
    on_timeout: str = 'hold'
    referred: bool = True  # whether a y_m has come
    reference_silent_s: float = 0.0
    intervals_s: tuple[float, float, float] = (nan, nan, nan)
    period: Period = UNKNOWN_PERIOD
    repeats_stamps: bool = False
    age_s: float = nan  # median time from the stamp of y to its arrival, nan while not known
    used: int = 0
    without_reference: int = 0
    lost: int = 0
    unsent: int = 0
    late: int = 0
    bad_outputs: int = 0
    bad_references: int = 0
    limited: int = 0
    unreported: int = 0
    dead_workers: int = 0
    still: int = 0
    v_swing: float = 0.0
    gap: float = nan
    wraps: int = 0

    @property
    def heard(self) -> int:
        """Samples that have come, whatever they were worth."""
        return self.used + self.without_reference + self.bad_outputs
