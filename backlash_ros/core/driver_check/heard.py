"""What was heard of a driver: messages, the ROS graph, and its samples, counted.

Pure: no ROS in here, so that every judgement can be tried on made-up messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.loop.command_history import v_of_intervals
from backlash_ros.core.loop.sample_counter import UNNUMBERED, SampleCounter

Array = NDArray[np.float64]

FEWEST_SAMPLES = 20  # for a judgement of the timing
MOST_LATE = 0.5  # of a period: beyond 0.85 the controller takes it for a loss


class Message(NamedTuple):
    """A number on a topic, when it left and arrived [ns], and its number in the sequence."""

    value: float
    stamp_ns: int
    received_ns: int
    number: int


@dataclass
class Graph:
    """What the ROS graph says about the topics of the driver.

    publishers, types, best_effort (without guarantee): of plant_output. listeners: of control,
    without the tools of this package. misfits: reasons why messages cannot pass, from QoS.
    near_control: subscribed topics of a name like control.
    """

    publishers: int = 0
    types: tuple[str, ...] = ()
    listeners: int = 0
    misfits: tuple[str, ...] = ()
    best_effort: bool = False
    near_control: tuple[str, ...] = ()


@dataclass
class Heard:
    """Messages of the three topics, and when listening ended [ns]."""

    outputs: list[Message] = field(default_factory=list)
    controls: list[Message] = field(default_factory=list)
    applied: list[Message] = field(default_factory=list)
    end_ns: int = 0

    @property
    def by_topic(self) -> dict[str, list[Message]]:
        """The lists, which grow, by their topics."""
        return {'plant_output': self.outputs, 'control': self.controls,
                'applied_control': self.applied}


class Timing(NamedTuple):
    """Samples without repetitions: their messages, their count from 0, and the period found.

    repeated: with the value of the one before. early: with another value, but long before they were
    due. lateness: of a period, exceeded by 1 % of the samples. fits: the period is the one of the
    parameters.
    """

    outputs: list[Message]
    numbers: NDArray[np.int64]
    period_s: float
    missing: int = 0
    repeated: int = 0
    early: int = 0
    lateness: float = 0.0
    fits: bool = True

    def v_of(self, messages: Sequence[Message], reported: bool) -> Array | None:
        """v over each sample interval (N,), nan before any; None where nothing tells it.

        reported: whether the messages are those of applied_control.
        """
        usable = [message for message in messages if plausible(message.value)]
        if not usable or not self.outputs:
            return None
        v = v_of_intervals(self.numbers, stamps_of(self.outputs), stamps_of(usable),
                           np.array([message.value for message in usable]), reported)
        return v if np.isfinite(v).any() else None

    def record(self, heard: Heard) -> tuple[Array, Array] | None:
        """v from sample k to k+1, as reported or else commanded, and y at k, nan where lost.

        From the first known v on; None where v or y was not heard.
        """
        v = self.v_of(heard.applied, True)
        v = self.v_of(heard.controls, False) if v is None else v
        if v is None:
            return None
        y = np.full(len(v), np.nan)
        y[self.numbers] = [m.value if plausible(m.value) else np.nan for m in self.outputs]
        known = int(np.argmax(np.isfinite(v)))
        return v[known:], y[known:]


def timing_of(heard: Heard, sample_period_s: float) -> Timing:
    """Sort out what came twice or early, and count the samples; none where they are too few."""
    outputs = _without_doubles(heard.outputs, 0.25e9 * sample_period_s)
    repeated = len(heard.outputs) - len(outputs)
    if repeated > 0.6 * len(heard.outputs):  # a plant at rest
        outputs, repeated = heard.outputs, 0
    if len(outputs) < FEWEST_SAMPLES:
        return Timing([], np.zeros(0, dtype=np.int64), sample_period_s, repeated=repeated)
    rough = max(float(np.median(np.diff(stamps_of(outputs)))), 1.0)
    counter = SampleCounter(rough * 1e-9)
    index, missing, samples = [], 0, []
    for message in outputs:
        arrival = counter.count(message.stamp_ns, message.number)
        if arrival.is_sample:
            missing += arrival.missing
            index.append(counter.index)
            samples.append(message)
    times = (stamps_of(samples) - samples[0].stamp_ns) * 1e-9
    numbers = np.array(index, dtype=np.int64) - index[0]
    slope = float(np.polyfit(numbers, times, 1)[0])
    lateness = float(np.ptp(np.quantile(times - slope * numbers, [0.01, 0.99]))) / slope
    # A driver that fell silent for good loses samples as well.
    missing += max(int((heard.end_ns - samples[-1].stamp_ns) / rough) - 1, 0)
    # Amid bursts the samples cannot be counted for certain; most intervals tell the period still.
    period, most_off = (slope, 0.01) if lateness <= MOST_LATE else (rough * 1e-9, 0.1)
    fits = abs(period / sample_period_s - 1.0) <= most_off
    return Timing(
        samples, numbers, period, missing, repeated, len(outputs) - len(samples), lateness, fits)


def stamps_of(messages: Sequence[Message]) -> NDArray[np.int64]:
    """When they left [ns]."""
    return np.array([message.stamp_ns for message in messages], dtype=np.int64)


def _without_doubles(outputs: Sequence[Message], soon_ns: float) -> list[Message]:
    """Without those that came again so soon; no gaps in the numbers where they were."""
    kept: list[Message] = []
    doubles = 0
    for message in outputs:
        if message.number != UNNUMBERED:
            message = message._replace(number=message.number - doubles)
        if kept and message.stamp_ns - kept[-1].stamp_ns <= soon_ns and (
                message.value == kept[-1].value or message.number == kept[-1].number != UNNUMBERED):
            doubles += message.number != kept[-1].number
        else:
            kept.append(message)
    return kept
