"""What was heard of a driver, and what there is to say about its messages and its timing.

Pure: no ROS in here, so that every judgement can be tried on made-up messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.loop.diagnosis import SKEW
from backlash_ros.core.loop.sample_counter import UNNUMBERED, SampleCounter

FLOAT64 = 'std_msgs/msg/Float64'

FITS, WRONG, UNKNOWN = '✓', '✗', '–'

FEWEST_SAMPLES = 20  # for a judgement of the timing
MOST_LATE = 0.5  # of a period: beyond 0.85 the controller takes it for a loss
LOSS = 0.01  # share of lost samples that a driver may have


class Message(NamedTuple):
    """A number on a topic, when it left and arrived [ns], and its number in the sequence."""

    value: float
    stamp_ns: int
    received_ns: int
    number: int


class Finding(NamedTuple):
    """A line of the verdict: what was looked at, whether it fits, what was found, what helps."""

    subject: str
    mark: str
    found: str
    cure: str = ''


@dataclass
class Graph:
    """What the ROS graph says about the topics of the driver.

    publishers: of plant_output. types: of plant_output. listeners: of control, without the
    tools of this package. misfits: reasons why messages cannot pass, from QoS.
    best_effort: whether plant_output is published without guarantee. near_control: subscribed
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


@dataclass
class Timing:
    """Samples without repetitions: their messages, their count from 0, and the period found."""

    outputs: list[Message]
    index: NDArray[np.intp]
    period_s: float
    missing: int
    repeated: int  # with the value of the one before
    early: int  # with another value, but long before they were due
    lateness: float  # of a period, exceeded by 1 % of the samples
    fits: bool  # the period is the one of the parameters


def finding(subject: str, fits: bool, found: str, cure: str) -> Finding:
    """A line with its cure where something does not fit."""
    return Finding(subject, FITS, found) if fits else Finding(subject, WRONG, found, cure)


def graph_findings(graph: Graph, accepts_best_effort: bool) -> list[Finding]:
    """Who publishes plant_output and who listens to control, and whether they understand."""
    if graph.publishers == 0:
        return [Finding(
            'publisher', WRONG, 'nobody publishes plant_output', 'start the driver',
        )]
    found = [finding(
        'publisher', graph.publishers == 1,
        'one publisher on plant_output' if graph.publishers == 1
        else f'{graph.publishers} publishers on plant_output',
        'stop all but one (`ros2 topic info -v plant_output` names them)',
    )]
    if graph.types != (FLOAT64,):
        found.append(Finding('type', WRONG, f'plant_output is {", ".join(graph.types)}',
                             f'publish y as {FLOAT64}'))
    reasons = list(graph.misfits)
    if graph.best_effort and not accepts_best_effort:
        reasons.append('plant_output is best effort, the controller asks for reliable')
    near = f', but somebody to {", ".join(graph.near_control)}' if graph.near_control else ''
    return [
        *found,
        finding('QoS', not reasons, '; '.join(reasons) or 'compatible',
                'use reliable, volatile, keep last (the default profile) on both topics'),
        finding('listener', graph.listeners > 0,
                'control is subscribed' if graph.listeners else f'nobody listens to control{near}',
                f'let the driver subscribe control as {FLOAT64}, or remap it'),
    ]


def timing_of(heard: Heard, sample_period_s: float) -> Timing | None:
    """Sort out what came twice or early, and count the samples; None where there are too few."""
    outputs, repeated = _without_doubles(heard.outputs, sample_period_s)
    if len(outputs) < FEWEST_SAMPLES:
        return None
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
    numbers = np.array(index, dtype=np.intp) - index[0]
    slope, offset = np.polyfit(numbers, times, 1)
    late = times - slope * numbers - offset
    lateness = float(np.quantile(late, 0.99) - np.quantile(late, 0.01)) / float(slope)
    # A driver that fell silent for good loses samples as well.
    missing += max(int((heard.end_ns - samples[-1].stamp_ns) / rough) - 1, 0)
    # Amid bursts the samples cannot be counted for certain; most intervals tell the period still.
    steady = lateness <= MOST_LATE
    period = float(slope) if steady else rough * 1e-9
    return Timing(
        samples, numbers, period, missing, repeated, len(outputs) - len(samples), lateness,
        abs(period / sample_period_s - 1.0) <= (0.01 if steady else 0.1),
    )


def stamps_of(messages: Sequence[Message]) -> NDArray[np.int64]:
    """When they left [ns]."""
    return np.array([message.stamp_ns for message in messages], dtype=np.int64)


def _without_doubles(
    outputs: Sequence[Message], sample_period_s: float,
) -> tuple[list[Message], int]:
    """Without those that came again within a quarter of a period, and how many these were."""
    kept = list(outputs[:1])
    numbered_doubles = 0  # they must not look like gaps in the numbers
    for message in outputs[1:]:
        if message.number != UNNUMBERED:
            message = message._replace(number=message.number - numbered_doubles)
        before = kept[-1]
        again = message.value == before.value or message.number == before.number != UNNUMBERED
        if not again or message.stamp_ns - before.stamp_ns > 0.25 * sample_period_s * 1e9:
            kept.append(message)
        elif message.number != before.number:
            numbered_doubles += 1
    repeated = len(outputs) - len(kept)
    # A larger share of equal values is a plant at rest.
    return (list(outputs), 0) if repeated > 0.6 * len(outputs) else (kept, repeated)


def message_findings(heard: Heard, timing: Timing, sample_period_s: float) -> list[Finding]:
    """Rate, jitter, loss, repetition, clock and numbers of what was heard."""
    rate = f'{1.0 / timing.period_s:.4g} Hz, a sample every {timing.period_s * 1e3:.4g} ms'
    total = len(timing.outputs) + timing.missing
    age = float(np.median([m.received_ns - m.stamp_ns for m in timing.outputs])) * 1e-9
    bad = {
        topic: sum(not plausible(message.value) for message in messages)
        for topic, messages in (('plant_output', heard.outputs), ('control', heard.controls),
                                ('applied_control', heard.applied))
    }
    return [
        finding('rate', timing.fits,
                rate if timing.fits
                else f'{rate}; sample_period says {sample_period_s * 1e3:g} ms',
                'publish once per sample_period, or set sample_period to what the driver does and '
                'give G(z) for it'),
        finding('jitter', timing.lateness <= MOST_LATE,
                f'{timing.lateness:.0%} of a period (98 % of the samples)',
                'publish from a timer with absolute deadlines; give the driver a real-time '
                'priority'),
        finding('lost samples', timing.missing <= LOSS * total,
                f'{timing.missing} of {total} samples',
                'publish every sample, reliable, without skipping any; on a network, use a cable'),
        _repetition(timing),
        finding('clock', abs(age) <= SKEW * timing.period_s,
                f'samples arrive {abs(age) * 1e3:.2g} ms {"before" if age < 0.0 else "after"} '
                'they left', 'synchronise the clocks of both machines (chrony, PTP), or look for a '
                'slow network'),
        finding('values', not any(bad.values()),
                'all finite' if not any(bad.values()) else 'nan, inf or absurd: '
                + ', '.join(f'{count} on {topic}' for topic, count in bad.items() if count),
                'publish nothing where the sensor has no value; the controller steps over it'),
    ]


def _repetition(timing: Timing) -> Finding:
    held = _held_share(np.array([message.value for message in timing.outputs]))
    for wrong, found, cure in (
        (timing.repeated > 0, f'{timing.repeated} came twice',
         'publish each sample once: take out what doubles them, a second timer or a relay'),
        (timing.early > LOSS * len(timing.outputs),
         f'{timing.early} came right after the one before',
         'let the timer of the driver leave out what it has missed instead of catching up'),
        (held > 0.2, f'{held:.0%} repeat the value before while y moves',
         'publish when the sensor has a new value; sample_period is that of the sensor'),
    ):
        if wrong:
            return Finding('repeated samples', WRONG, found, cure)
    return Finding('repeated samples', FITS, 'none')


def _held_share(y: NDArray[np.float64]) -> float:
    """Share of samples equal to the one before, of those amid a motion of many resolutions."""
    fine_steps = 5.0  # steps of y larger than this many resolutions need not repeat
    y = y[np.isfinite(y)]
    steps = np.abs(np.diff(y))
    moving = steps[steps > 0.0]
    if len(moving) < FEWEST_SAMPLES or np.median(moving) < fine_steps * moving.min():
        return 0.0
    around = np.abs(y[2:] - y[:-2]) >= fine_steps * moving.min()
    return float(np.mean(steps[1:][around] == 0.0)) if around.any() else 0.0
