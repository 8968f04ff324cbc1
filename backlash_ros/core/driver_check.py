"""Judge a driver by its ROS graph, its messages and its motion: what is wrong, and the cure.

Each fault is reported once. What it hides is not judged: at a wrong rate G(z) cannot be checked.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.loop.command_history import REPORTED, report_use, v_of_intervals
from backlash_ros.core.loop.diagnosis import SKEW, TROUBLE
from backlash_ros.core.loop.sample_counter import UNNUMBERED, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import Array, TransferFunction
from backlash_ros.core.record_fit import fit_record
from backlash_ros.core.records.readings import frequencies_of, own_readings

FLOAT64 = 'std_msgs/msg/Float64'
FITS, WRONG, UNKNOWN = '✓', '✗', '–'
MOTION = ('reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash')
MESSAGES = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
ORDER = ('publisher', 'type', 'QoS', 'listener', *MESSAGES, 'applied_control', *MOTION)
FEWEST_SAMPLES = 20  # needed to judge the timing
MORE_DELAY = 8  # samples beyond the expected delay that are tried


class Message(NamedTuple):
    """A value on a topic, when it was sent and received [ns], and its sequence number."""

    value: float
    stamp_ns: int
    received_ns: int
    number: int


@dataclass
class Graph:
    """Who is on plant_output and control in the ROS graph, apart from tools of this package."""

    publishers: int = 0
    types: tuple[str, ...] = ()
    listeners: int = 0
    misfits: tuple[str, ...] = ()  # why the QoS keeps control from its subscribers
    best_effort: bool = False  # whether plant_output is
    near_control: tuple[str, ...] = ()  # subscribed topics whose name is like control


@dataclass
class Heard:
    """The messages heard so far on the three topics, and when listening ended [ns]."""

    outputs: list[Message] = field(default_factory=list)
    controls: list[Message] = field(default_factory=list)
    applied: list[Message] = field(default_factory=list)
    end_ns: int = 0

    @property
    def by_topic(self) -> dict[str, list[Message]]:
        return {'plant_output': self.outputs, 'control': self.controls,
                'applied_control': self.applied}


class Sampling(NamedTuple):
    """Samples without repetitions, a row each, their numbers from 0 and their period.

    repeated: number of messages that came twice. early: number that came long before they were due.
    lateness: spread of the stamps of 98 % of the samples, in periods. bursts: too large to count
    them with certainty. commanded, reported: v over each interval (N,), nan before any, or None.
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
        """v from sample k to k+1 and y at k, nan where lost, from the first known v on, or None."""
        v = self.commanded if self.reported is None else self.reported
        if v is None:
            return None
        y = np.full(len(v), np.nan)
        y[self.numbers] = [value if plausible(value) else np.nan for value in self.outputs['value']]
        known = int(np.argmax(np.isfinite(v)))
        return v[known:], y[known:]


def timing_of(heard: Heard, sample_period_s: float) -> Sampling:
    """Count the samples, without those that came twice or early; returns no rows if too few."""
    fields = [('value', 'f8'), ('stamp_ns', 'i8'), ('received_ns', 'i8'), ('number', 'u8')]
    sent = np.array(heard.outputs, fields)
    before = np.roll(sent, 1)
    same_number = sent['number'] == before['number']
    again = (sent['stamp_ns'] - before['stamp_ns'] <= 0.25e9 * sample_period_s) & (
        (sent['value'] == before['value']) | (same_number & (sent['number'] != UNNUMBERED)))
    again[:1] = False
    if again.sum() > 0.6 * len(sent):  # a plant at rest
        again[:] = False
    # What is left out is to leave no gap in the numbers.
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
    bursts = lateness > 0.5  # the controller takes more than 0.85 for a loss
    # A driver that fell silent for good loses samples as well.
    silent = max(int((heard.end_ns - stamps[-1]) / rough) - 1, 0)

    def v_of(messages: Sequence[Message], reported: bool) -> Array | None:
        valid = np.array([m for m in messages if plausible(m.value)], fields)
        v = v_of_intervals(numbers, stamps, valid['stamp_ns'], valid['value'], reported)
        return v if np.isfinite(v).any() else None

    return Sampling(
        outputs, numbers, rough * 1e-9 if bursts else period,
        int(numbers[-1]) + 1 - len(outputs) + silent, int(again.sum()), len(sent) - len(outputs),
        lateness, bursts, v_of(heard.controls, False), v_of(heard.applied, True))


class Judgement(NamedTuple):
    """A line of the verdict: what was checked, whether it fits, what was found, and the cure."""

    subject: str
    mark: str
    found: str
    cure: str = ''


class Row(NamedTuple):
    """What to say of a subject if it is wrong, which hides others; or else `well`, if not empty."""

    subject: str
    wrong: object
    found: str
    cure: str
    hides: Sequence[str] = ()
    well: str = ''


def judge(graph: Graph, heard: Heard, p: Parameters) -> list[Judgement]:
    """All findings on a driver, the first on each subject. p: parameters of the controller."""
    if not graph.publishers:
        return [Judgement('publisher', WRONG, 'nobody publishes plant_output', 'start the driver')]
    lines: dict[str, Judgement] = {}
    timing = timing_of(heard, p.sample_period)
    # With jitter it is uncertain which v led to which y: what seems wrong may be right.
    blurred = ('reaction delay', 'G(z)', 'noise on y') if timing.bursts else ()
    for row in chain(_of_graph(graph, p), _of_messages(heard, timing, p),
                     _of_reports(heard, timing, p), _of_motion(timing, p)):
        if row.subject in MOTION and 'backlash' in lines:
            break
        if row.wrong and row.subject not in lines:
            lines[row.subject] = _hidden(row.subject, 'jitter') if row.subject in blurred else \
                Judgement(row.subject, WRONG, row.found, row.cure)
            lines = {other: _hidden(other, row.subject) for other in row.hides} | lines
        elif row.well:
            lines.setdefault(row.subject, Judgement(row.subject, FITS, row.well))
    return [lines[subject] for subject in ORDER if subject in lines]


def _hidden(subject: str, behind: str) -> Judgement:
    return Judgement(subject, UNKNOWN, f'can be judged once {behind} fits')


def _of_graph(graph: Graph, p: Parameters) -> Iterator[Row]:
    all_else = (*MESSAGES, *MOTION)
    yield Row('publisher', graph.publishers > 1, f'{graph.publishers} publishers on plant_output',
              'stop all but one (`ros2 topic info -v plant_output` names them)', all_else,
              'one publisher on plant_output')
    yield Row('type', graph.types != (FLOAT64,), f'plant_output is {", ".join(graph.types)}',
              f'publish y as {FLOAT64}', all_else)
    deaf = graph.best_effort and not p.io.best_effort
    misfits = (*graph.misfits, *['plant_output is best effort, control reliable'] * deaf)
    yield Row('QoS', misfits, '; '.join(misfits), 'use reliable, volatile, keep last (the default '
              'profile) on both topics', well='compatible')
    near = f', but somebody to {", ".join(graph.near_control)}' if graph.near_control else ''
    yield Row('listener', not graph.listeners, f'nobody listens to control{near}',
              f'let the driver subscribe control as {FLOAT64}, or remap it', MOTION,
              'control is subscribed')


def _of_messages(heard: Heard, timing: Sampling, p: Parameters) -> Iterator[Row]:
    count, period = len(timing.outputs), timing.period_s
    yield Row('rate', not count, f'{len(heard.outputs)} samples heard, {FEWEST_SAMPLES} are needed',
              'publish plant_output without pause; raise --duration', (*MESSAGES, *MOTION))
    if not count:
        return
    rate = f'{1.0 / period:.4g} Hz, a sample every {period * 1e3:.4g} ms'
    off = abs(period / p.sample_period - 1.0)
    yield Row('rate', off > (0.1 if timing.bursts else 0.01),
              f'{rate}; sample_period says {p.sample_period * 1e3:g} ms', 'publish once per '
              'sample_period, or set sample_period to what the driver does and give G(z) for it',
              MOTION, rate)
    jitter = f'{timing.lateness:.0%} of a period (98 % of the samples)'
    yield Row('jitter', timing.bursts, jitter, 'publish from a timer with absolute deadlines; give '
              'the driver a real-time priority', well=jitter)
    lost = f'{timing.missing} of {count + timing.missing} samples'
    yield Row('lost samples', timing.missing > TROUBLE * (count + timing.missing), lost, 'publish '
              'every sample, reliable, without skipping any; on a network, use a cable', well=lost)
    yield Row('repeated samples', timing.repeated, f'{timing.repeated} came twice', 'publish each '
              'sample once: take out what doubles them, a second timer or a relay')
    yield Row('repeated samples', timing.early > TROUBLE * count, f'{timing.early} came right '
              'after the one before', 'leave out what a timer missed instead of catching up')
    _, slower_s = own_readings(np.asarray(period * timing.numbers), timing.outputs['value'])
    yield Row('repeated samples', slower_s, f'y changes every {slower_s * 1e3:.3g} ms only',
              'publish when the sensor has a new value; sample_period is its period', well='none')
    age_s = 1e-9 * float(np.median(timing.outputs['received_ns'] - timing.outputs['stamp_ns']))
    side = 'before' if age_s < 0.0 else 'after'
    age = f'samples arrive {abs(age_s) * 1e3:.2g} ms {side} they left'
    yield Row('clock', abs(age_s) > SKEW * period, age, 'synchronise the clocks of both machines '
              '(chrony, PTP), or look for a slow network', MOTION, age)
    absurd = ', '.join(f'{count} on {topic}' for topic, messages in heard.by_topic.items()
                       if (count := sum(not plausible(m.value) for m in messages)))
    yield Row('values', absurd, f'nan, inf or absurd: {absurd}',
              'publish nothing where the sensor has no value', well='all finite')


def _lag_and_limit(timing: Sampling) -> tuple[int, float]:
    """Samples by which applied_control lags control, and by how much it is limited, 0 if not."""
    control, applied = timing.commanded, timing.reported
    if control is None or applied is None:
        return 0, 0.0
    off = [np.abs(applied[lag:] - control[:len(control) - lag]) for lag in range(MORE_DELAY + 1)]
    off = [each[np.isfinite(each)] for each in off]
    lag = int(np.argmin([each.mean() if len(each) else inf for each in off]))
    # v is limited if more than 5 % of the samples differ by more than 2 % of the swing.
    beyond = off[lag] > 0.02 * (np.nanmax(control) - np.nanmin(control))
    return lag, float(off[lag].max()) if beyond.sum() > 0.05 * len(beyond) else 0.0


def _of_reports(heard: Heard, timing: Sampling, p: Parameters) -> Iterator[Row]:
    use, share = report_use(p), len(heard.applied) / max(len(timing.outputs), 1)
    _, limited_by = _lag_and_limit(timing)
    wanted = use == 'true' or (use == 'auto' and share > 0.0)
    yield Row('applied_control', wanted and share < REPORTED,
              f'comes with {share:.0%} of the samples' if share else 'is not published',
              'report v just before each y, or set estimator.use_applied_control: false')
    well = 'differs from control, as it may' if limited_by else 'agrees with control'
    yield Row('applied_control', use == 'false' and limited_by,
              f'differs from control by up to {limited_by:.3g}',
              'set estimator.use_applied_control: true, or narrow control.min, max, rate_max',
              well=(well if heard.controls else 'is published') if share else '')


def _of_motion(timing: Sampling, p: Parameters) -> Iterator[Row]:
    """Judge how y follows the v that acted, by a fit of the whole record."""
    past = 'swing v wider than the gap in both directions, several times: check_driver --drive'
    if timing.record is None:
        yield Row('backlash', True, 'v was not heard', past, MOTION)
        return
    (v, y), expected = timing.record, p.control.delay_samples
    noise_std = p.estimator.output_noise_std
    fit = fit_record(
        v, y, TransferFunction(p.plant.numerator, p.plant.denominator), p.plant.uncertainty,
        noise_std, p.estimator.bounds, range(expected + MORE_DELAY + 1))
    best = fit.fit
    if best is None:
        yield Row('backlash', True, ''.join(fit.doubts[:1]), past, MOTION)
        return
    unseen = f'not identifiable from this motion: v swung by {np.ptp(v):.4g}'
    # If the play never turns, lag and delay absorb the effect of the gap.
    explained = fit.predicted >= 0.9  # of the motion of y
    yield Row('backlash', fit.reversals == 0 and explained, f'{unseen} on one side', past, MOTION)
    # A report that is used contains the lag already.
    lag = 0 if report_use(p) == 'true' else _lag_and_limit(timing)[0]
    another_delay = fit.margins.get(expected - lag, inf) > 3.0  # log-likelihood
    noisy = best.noise > 3.0 * noise_std  # more than a guess may be off
    coloured = best.left.correlation > 0.5  # unlike the noise of a sensor
    predicted = f'predicts {max(fit.predicted, 0.0):.1%} of the motion of y'
    between, corrected = frequencies_of(y), predicted
    if fit.model is not fit.nominal:  # the loop learns it too
        corrected += ' once it is corrected: it is off by ' + ', '.join(
            f'{error:.1%} at {frequency / (2.0 * pi * p.sample_period):.2g} Hz'
            for frequency, error in zip(between, fit.error_of_model(between), strict=True))
    # An unexpected delay together with a large, coloured residual means a wrong G, too.
    yield Row('G(z)', not explained or (noisy and coloured and another_delay), predicted,
              'enter the G(z) of this plant, discretised with sample_period; check that y is '
              'measured behind the gap and that the driver holds v over the period', MOTION)
    yield Row('G(z)', best.scale > 2.0,
              f'{corrected}, by more than twice plant.uncertainty={p.plant.uncertainty:g}',
              'check that it is discretised with sample_period, or raise plant.uncertainty',
              well=corrected)
    yield Row('reaction delay', another_delay,
              f'{fit.delay + lag} samples; control.delay_samples says {expected}',
              f'apply v as soon as it comes, or set control.delay_samples: {fit.delay + lag}',
              well=f'{expected} samples, as control.delay_samples says')
    yield Row('sign and units', fit.against, ''.join(fit.against),
              'change the sign of y or v in the driver, or of plant.numerator')
    # While the gap is in doubt, m alone is compared with its bounds.
    outside = [each for each in fit.outside if each.startswith('m ') or not fit.doubts]
    yield Row('sign and units', outside, ', '.join(outside), 'see the units of v, y and G(z) and '
              'the zero of v, or widen estimator.bounds',
              well=f'm is about {fit.estimates["m"][0]:.4g}, within its bounds')
    noise = f'deviation {best.noise:.2g}; estimator.output_noise_std says {noise_std:.2g}'
    yield Row('noise on y', noisy, noise, f'set estimator.output_noise_std: {best.noise:.1e}' + (
        ', or give a more exact G(z): the residual is coloured' if coloured else ''), well=noise)
    yield Row('backlash', fit.doubts, f'{unseen}; {"; ".join(fit.doubts)}', past, well=', '.join(
        f'{name} = {value:.4g} ± {std:.1g}' for name, (value, std) in fit.estimates.items()))


def all_fit(judgements: Iterable[Judgement]) -> bool:
    """Whether nothing is wrong or unknown."""
    return all(each.mark == FITS for each in judgements)


def table(judgements: Sequence[Judgement]) -> str:
    """One line for each finding, with the cure below if something is wrong."""
    width = max(len(each.subject) for each in judgements)
    return '\n'.join(
        f'{each.mark} {each.subject.ljust(width)}  {each.found}'
        + (f'\n  {" " * width}  → {each.cure}' if each.cure else '') for each in judgements)
