"""What was heard of a driver, without ROS: messages, the ROS graph, and its samples, counted."""

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


class Message(NamedTuple):
    """A number on a topic, when it left and arrived [ns], and its number in the sequence."""

    value: float
    stamp_ns: int
    received_ns: int
    number: int


@dataclass
class Graph:
    """What the ROS graph says about the topics of the driver.

    publishers, types, best_effort: of plant_output. listeners: of control, without the tools of
    this package. misfits: reasons why messages cannot pass, from QoS. near_control: subscribed
    topics of a name like control.
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


class Sampling(NamedTuple):
    """Samples without repetitions, a row each, their count from 0 and their period.

    commanded, reported: v over each sample interval (N,), nan before any; None where nothing tells
    it. repeated: with the value of the one before. early: with another value, but long before they
    were due. lateness: of a period, exceeded by 1 % of the samples. bursts: they are so late that
    they cannot be counted for certain.
    """

    outputs: NDArray[np.void]
    numbers: NDArray[np.int64]
    period_s: float
    missing: int = 0
    repeated: int = 0
    early: int = 0
    lateness: float = 0.0
    bursts: bool = False
    commanded: Array | None = None
    reported: Array | None = None

    @property
    def record(self) -> tuple[Array, Array] | None:
        """v from sample k to k+1 and y at k, nan where lost, from the first known v on, if any."""
        v = self.commanded if self.reported is None else self.reported
        if v is None:
            return None
        y = np.full(len(v), np.nan)
        y[self.numbers] = [value if plausible(value) else np.nan
                           for value in self.outputs['value'].tolist()]
        known = int(np.argmax(np.isfinite(v)))
        return v[known:], y[known:]


def timing_of(heard: Heard, sample_period_s: float) -> Sampling:
    """Sort out what came twice or early, and count the samples; none where they are too few."""
    fields = [('value', 'f8'), ('stamp_ns', 'i8'), ('received_ns', 'i8'), ('number', 'u8')]
    sent = np.array(heard.outputs, fields)
    before = np.roll(sent, 1)
    same_number = sent['number'] == before['number']
    again = (sent['stamp_ns'] - before['stamp_ns'] <= 0.25e9 * sample_period_s) & (
        (sent['value'] == before['value']) | (same_number & (sent['number'] != UNNUMBERED)))
    again[:1] = False
    repeated = int(again.sum())
    if repeated > 0.6 * len(sent):  # a plant at rest
        again[:], repeated = False, 0
    # No gaps in the numbers where they were.
    sent['number'] -= np.cumsum(again & ~same_number, dtype=np.uint64)
    sent = sent[~again]
    if len(sent) < FEWEST_SAMPLES:
        return Sampling(sent[:0], np.zeros(0, dtype=np.int64), sample_period_s)
    rough = max(float(np.median(np.diff(sent['stamp_ns']))), 1.0)
    counter = SampleCounter(rough * 1e-9)
    index = np.array([counter.index if counter.count(stamp_ns, number).is_sample else -1
                      for _, stamp_ns, _, number in sent.tolist()])
    outputs, numbers = sent[index >= 0], index[index >= 0] - index[0]
    stamps = outputs['stamp_ns']
    times = (stamps - stamps[0]) * 1e-9
    period = float(np.polyfit(numbers, times, 1)[0])
    lateness = float(np.ptp(np.quantile(times - period * numbers, [0.01, 0.99]))) / period
    bursts = lateness > 0.5  # beyond 0.85 the controller takes it for a loss
    # A driver that fell silent for good loses samples as well.
    silent = max(int((heard.end_ns - stamps[-1]) / rough) - 1, 0)

    def v_of(messages: Sequence[Message], reported: bool) -> Array | None:
        told = np.array([m for m in messages if plausible(m.value)], fields)
        v = v_of_intervals(numbers, stamps, told['stamp_ns'], told['value'], reported)
        return v if np.isfinite(v).any() else None

    return Sampling(
        outputs, numbers, rough * 1e-9 if bursts else period,
        int(numbers[-1]) + 1 - len(outputs) + silent, repeated, len(sent) - len(outputs), lateness,
        bursts, v_of(heard.controls, False), v_of(heard.applied, True))
