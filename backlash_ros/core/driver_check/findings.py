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
PERIOD_TOLERANCE = 0.01  # what the controller's count of samples follows
UNSTEADY_TOLERANCE = 0.1  # where samples come in bursts
LATENESS = 0.5  # of a period: beyond 0.85 the controller takes it for a loss
LOSS = 0.01  # share of lost samples that a driver may have
DOUBLE = 0.25  # of a period: the same value again within it is the same sample
MOSTLY = 0.6  # a larger share of equal values is a plant at rest, not repetition
HELD = 0.2  # share of samples that repeat the one before while y moves
FINE_STEPS = 5.0  # steps of y larger than this many resolutions need not repeat


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


def graph_findings(graph: Graph, accepts_best_effort: bool) -> list[Finding]:
    """Who publishes plant_output and who listens to control, and whether they understand."""
    if graph.publishers == 0:
        return [Finding(
            'publisher', WRONG, 'nobody publishes plant_output', 'start the driver',
        )]
    findings = [_publishers(graph.publishers)]
    if graph.types != (FLOAT64,):
        findings.append(Finding(
            'type', WRONG, f'plant_output is {", ".join(graph.types)}',
            f'publish y as {FLOAT64}',
        ))
    findings.append(_qos(graph, accepts_best_effort))
    if graph.listeners == 0:
        near = ', '.join(graph.near_control)
        findings.append(Finding(
            'listener', WRONG,
            'nobody listens to control' + (f', but somebody to {near}' if near else ''),
            f'let the driver subscribe control as {FLOAT64}, or remap it',
        ))
    else:
        findings.append(Finding('listener', FITS, 'control is subscribed'))
    return findings


def _publishers(count: int) -> Finding:
    if count > 1:
        return Finding(
            'publisher', WRONG, f'{count} publishers on plant_output',
            'stop all but one (`ros2 topic info -v plant_output` names them)',
        )
    return Finding('publisher', FITS, 'one publisher on plant_output')


def _qos(graph: Graph, accepts_best_effort: bool) -> Finding:
    reasons = list(graph.misfits)
    if graph.best_effort and not accepts_best_effort:
        reasons.append('plant_output is best effort, the controller asks for reliable')
    if not reasons:
        return Finding('QoS', FITS, 'compatible')
    return Finding(
        'QoS', WRONG, '; '.join(reasons),
        'use reliable, volatile, keep last (the default profile) on both topics',
    )


def timing_of(heard: Heard, sample_period_s: float) -> Timing | None:
    """Sort out what came twice or early, and count the samples; None where there are too few."""
    outputs, repeated = _without_doubles(heard.outputs, sample_period_s)
    if len(outputs) < FEWEST_SAMPLES:
        return None
    stamps = np.array([message.stamp_ns for message in outputs], dtype=np.int64)
    rough = max(float(np.median(np.diff(stamps))), 1.0)
    counter = SampleCounter(rough * 1e-9)
    index, missing, samples = [], 0, []
    for message in outputs:
        arrival = counter.count(message.stamp_ns, message.number)
        if arrival.is_sample:
            missing += arrival.missing
            index.append(counter.index)
            samples.append(message)
    early = len(outputs) - len(samples)
    outputs, stamps = samples, np.array([message.stamp_ns for message in samples], dtype=np.int64)
    numbers = np.array(index, dtype=np.intp) - index[0]
    slope, offset = np.polyfit(numbers, (stamps - stamps[0]) * 1e-9, 1)
    late = (stamps - stamps[0]) * 1e-9 - slope * numbers - offset
    lateness = float(np.quantile(late, 0.99) - np.quantile(late, 0.01)) / float(slope)
    # A driver that fell silent for good loses samples as well.
    missing += max(int((heard.end_ns - outputs[-1].stamp_ns) / rough) - 1, 0)
    # Amid bursts the samples cannot be counted for certain; most intervals tell the period still.
    steady = lateness <= LATENESS
    period = float(slope) if steady else rough * 1e-9
    tolerance = PERIOD_TOLERANCE if steady else UNSTEADY_TOLERANCE
    return Timing(
        outputs, numbers, period, missing, repeated, early, lateness,
        abs(period / sample_period_s - 1.0) <= tolerance,
    )


def _without_doubles(
    outputs: Sequence[Message], sample_period_s: float,
) -> tuple[list[Message], int]:
    kept = list(outputs[:1])
    numbered_doubles = 0  # they must not look like gaps in the numbers
    for message in outputs[1:]:
        if message.number != UNNUMBERED:
            message = message._replace(number=message.number - numbered_doubles)
        before = kept[-1]
        again = message.value == before.value or message.number == before.number != UNNUMBERED
        if not again or message.stamp_ns - before.stamp_ns > DOUBLE * sample_period_s * 1e9:
            kept.append(message)
        elif message.number != before.number:
            numbered_doubles += 1
    repeated = len(outputs) - len(kept)
    if repeated > MOSTLY * len(outputs):
        return list(outputs), 0
    return kept, repeated


def message_findings(heard: Heard, timing: Timing, sample_period_s: float) -> list[Finding]:
    """Rate, jitter, loss, repetition, clock and numbers of what was heard."""
    return [
        _rate(timing, sample_period_s), _jitter(timing), _loss(timing), _repetition(timing),
        _clock(timing), _numbers(heard),
    ]


def _rate(timing: Timing, sample_period_s: float) -> Finding:
    found = f'{1.0 / timing.period_s:.4g} Hz, a sample every {timing.period_s * 1e3:.4g} ms'
    if timing.fits:
        return Finding('rate', FITS, found)
    return Finding(
        'rate', WRONG, f'{found}; sample_period says {sample_period_s * 1e3:g} ms',
        'publish once per sample_period, or set sample_period to what the driver does and '
        'give G(z) for it',
    )


def _jitter(timing: Timing) -> Finding:
    found = f'{timing.lateness:.0%} of a period (98 % of the samples)'
    if timing.lateness <= LATENESS:
        return Finding('jitter', FITS, found)
    return Finding(
        'jitter', WRONG, found,
        'publish from a timer with absolute deadlines; give the driver a real-time priority',
    )


def _loss(timing: Timing) -> Finding:
    total = len(timing.outputs) + timing.missing
    found = f'{timing.missing} of {total} samples'
    if timing.missing <= LOSS * total:
        return Finding('lost samples', FITS, found)
    return Finding(
        'lost samples', WRONG, found,
        'publish every sample, reliable, without skipping any; on a network, use a cable',
    )


def _repetition(timing: Timing) -> Finding:
    if timing.repeated:
        return Finding(
            'repeated samples', WRONG, f'{timing.repeated} came twice',
            'publish each sample once: take out what doubles them, a second timer or a relay',
        )
    if timing.early > LOSS * len(timing.outputs):
        return Finding(
            'repeated samples', WRONG, f'{timing.early} came right after the one before',
            'let the timer of the driver leave out what it has missed instead of catching up',
        )
    share = _held_share(np.array([message.value for message in timing.outputs]))
    if share > HELD:
        return Finding(
            'repeated samples', WRONG, f'{share:.0%} repeat the value before while y moves',
            'publish when the sensor has a new value; sample_period is that of the sensor',
        )
    return Finding('repeated samples', FITS, 'none')


def _held_share(y: NDArray[np.float64]) -> float:
    """Share of samples equal to the one before, of those amid a motion of many resolutions."""
    y = y[np.isfinite(y)]
    steps = np.abs(np.diff(y))
    moving = steps[steps > 0.0]
    if len(moving) < FEWEST_SAMPLES or np.median(moving) < FINE_STEPS * moving.min():
        return 0.0
    around = np.abs(y[2:] - y[:-2]) >= FINE_STEPS * moving.min()
    return float(np.mean(steps[1:][around] == 0.0)) if around.any() else 0.0


def _clock(timing: Timing) -> Finding:
    age = float(np.median([m.received_ns - m.stamp_ns for m in timing.outputs])) * 1e-9
    when = 'before' if age < 0.0 else 'after'
    found = f'samples arrive {abs(age) * 1e3:.2g} ms {when} they left'
    if abs(age) <= SKEW * timing.period_s:
        return Finding('clock', FITS, found)
    return Finding(
        'clock', WRONG, found,
        'synchronise the clocks of both machines (chrony, PTP), or look for a slow network',
    )


def _numbers(heard: Heard) -> Finding:
    topics = {
        'plant_output': heard.outputs, 'control': heard.controls,
        'applied_control': heard.applied,
    }
    bad = {
        topic: sum(not plausible(message.value) for message in messages)
        for topic, messages in topics.items()
    }
    if not any(bad.values()):
        return Finding('values', FITS, 'all finite')
    found = ', '.join(f'{count} on {topic}' for topic, count in bad.items() if count)
    return Finding(
        'values', WRONG, f'nan, inf or absurd: {found}',
        'publish nothing where the sensor has no value; the controller steps over it',
    )
