"""All that may be wrong with a driver, and the cure: its graph, its messages, its motion.

Each fault shows once. What a fault hides is not judged: amid lost samples nobody knows G(z).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check.heard import (
    FEWEST_SAMPLES,
    MOST_LATE,
    Graph,
    Heard,
    Timing,
    timing_of,
)
from backlash_ros.core.driver_check.record_fit import RecordFit, fit_record
from backlash_ros.core.loop.command_history import REPORTED, ReportUse, report_use
from backlash_ros.core.loop.diagnosis import SKEW, TROUBLE
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.records.readings import own_readings
from backlash_ros.core.records.samples import frequencies_of

Array = NDArray[np.float64]

FLOAT64 = 'std_msgs/msg/Float64'
FITS, WRONG, UNKNOWN = '✓', '✗', '–'

MOTION = ('reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash')
MESSAGES = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
ORDER = ('publisher', 'type', 'QoS', 'listener', *MESSAGES, 'applied_control', *MOTION)

DECISIVE = 3.0  # log-likelihood by which one delay beats another
WELL_PREDICTED = 0.9  # share of the motion of y that G has to predict
MORE_DELAY = 8  # samples that are tried beyond the expected delay

PAST = 'swing v past the gap in both directions, several times; raise --duration'


class Judgement(NamedTuple):
    """A line of the verdict: what was looked at, whether it fits, what was found, what helps."""

    subject: str
    mark: str
    found: str
    cure: str = ''


class Verdict:
    """Judgements by their subject, of which the first one counts."""

    def __init__(self) -> None:
        self.lines: dict[str, Judgement] = {}

    def check(
        self, subject: str, wrong: object, found: str, cure: str, hides: Sequence[str] = (),
        well: str = '',
    ) -> None:
        """Say what is wrong, if anything is, and else what is well.

        hides: subjects that cannot be judged then. well: '' while more is to be checked.
        """
        if wrong and subject not in self.lines:
            # Amid jitter it is uncertain which v led to which y: what does not fit may do so.
            blurred = subject in ('reaction delay', 'G(z)', 'noise on y') and \
                'jitter' in self.lines and self.lines['jitter'].mark == WRONG
            self.lines[subject] = _hidden(subject, 'jitter') if blurred else \
                Judgement(subject, WRONG, found, cure)
            for other in hides:
                self.lines.setdefault(other, _hidden(other, subject))
        elif well:
            self.lines.setdefault(subject, Judgement(subject, FITS, well))


def _hidden(subject: str, behind: str) -> Judgement:
    return Judgement(subject, UNKNOWN, f'can be told once {behind} fits')


def judge(graph: Graph, heard: Heard, p: Parameters) -> list[Judgement]:
    """All findings on a driver; p: parameters of the controller."""
    if not graph.publishers:
        return [Judgement('publisher', WRONG, 'nobody publishes plant_output', 'start the driver')]
    verdict, timing = Verdict(), timing_of(heard, p.sample_period)
    _judge_graph(verdict, graph, p)
    if 'rate' not in verdict.lines:
        _judge_messages(verdict, heard, timing, p)
    lag = _judge_reports(verdict, heard, timing, p)
    if 'backlash' not in verdict.lines:
        _judge_motion(verdict, timing, timing.v_acted(heard), lag, p)
    return [verdict.lines[subject] for subject in ORDER if subject in verdict.lines]


def _judge_graph(verdict: Verdict, graph: Graph, p: Parameters) -> None:
    verdict.check(
        'publisher', graph.publishers > 1, f'{graph.publishers} publishers on plant_output',
        'stop all but one (`ros2 topic info -v plant_output` names them)', (*MESSAGES, *MOTION),
        'one publisher on plant_output')
    verdict.check(
        'type', graph.types != (FLOAT64,), f'plant_output is {", ".join(graph.types)}',
        f'publish y as {FLOAT64}', (*MESSAGES, *MOTION))
    deaf = graph.best_effort and not p['io.best_effort']
    misfits = (*graph.misfits, *[
        'plant_output is best effort, the controller asks for reliable'] * deaf)
    verdict.check('QoS', misfits, '; '.join(misfits), 'use reliable, volatile, keep last (the '
                  'default profile) on both topics', well='compatible')
    near = f', but somebody to {", ".join(graph.near_control)}' if graph.near_control else ''
    verdict.check('listener', not graph.listeners, f'nobody listens to control{near}',
                  f'let the driver subscribe control as {FLOAT64}, or remap it', MOTION,
                  'control is subscribed')


def _judge_messages(verdict: Verdict, heard: Heard, timing: Timing, p: Parameters) -> None:
    count = len(timing.outputs)
    if count < FEWEST_SAMPLES:
        verdict.check('rate', True, f'{len(heard.outputs)} samples heard, {FEWEST_SAMPLES} are '
                      'needed', 'see that plant_output is published without pause; raise '
                      '--duration', (*MESSAGES, *MOTION))
        return
    rate = f'{1.0 / timing.period_s:.4g} Hz, a sample every {timing.period_s * 1e3:.4g} ms'
    verdict.check(
        'rate', not timing.fits, f'{rate}; sample_period says {p.sample_period * 1e3:g} ms',
        'publish once per sample_period, or set sample_period to what the driver does and give '
        'G(z) for it', MOTION, rate)
    jitter = f'{timing.lateness:.0%} of a period (98 % of the samples)'
    verdict.check('jitter', timing.lateness > MOST_LATE, jitter, 'publish from a timer with '
                  'absolute deadlines; give the driver a real-time priority', well=jitter)
    total = count + timing.missing
    lost = f'{timing.missing} of {total} samples'
    verdict.check('lost samples', timing.missing > TROUBLE * total, lost, 'publish every sample, '
                  'reliable, without skipping any; on a network, use a cable', well=lost)
    verdict.check(
        'repeated samples', timing.repeated, f'{timing.repeated} came twice',
        'publish each sample once: take out what doubles them, a second timer or a relay')
    verdict.check('repeated samples', timing.early > TROUBLE * count,
                  f'{timing.early} came right after the one before', 'let the timer of the driver '
                  'leave out what it has missed instead of catching up')
    y = np.array([message.value for message in timing.outputs])
    _, slower_s = own_readings(timing.period_s * timing.numbers.astype(float), y)
    verdict.check(
        'repeated samples', slower_s, f'y changes every {slower_s * 1e3:.3g} ms only, and repeats '
        'between', 'publish when the sensor has a new value; sample_period is that of the sensor',
        well='none')
    age_s = 1e-9 * float(np.median([m.received_ns - m.stamp_ns for m in timing.outputs]))
    age = f'samples arrive {abs(age_s) * 1e3:.2g} ms {"before" if age_s < 0.0 else "after"} they ' \
          'left'
    verdict.check(
        'clock', abs(age_s) > SKEW * timing.period_s, age,
        'synchronise the clocks of both machines (chrony, PTP), or look for a slow network', MOTION,
        age)
    counts = {topic: sum(not plausible(message.value) for message in messages)
              for topic, messages in heard.by_topic.items()}
    absurd = ', '.join(f'{count} on {topic}' for topic, count in counts.items() if count)
    verdict.check('values', absurd, f'nan, inf or absurd: {absurd}',
                  'publish nothing where the sensor has no value; the controller steps over it',
                  well='all finite')


def _judge_reports(verdict: Verdict, heard: Heard, timing: Timing, p: Parameters) -> int:
    """Judge applied_control; return the samples by which it follows control."""
    control, applied = timing.v_of(heard.controls, False), timing.v_of(heard.applied, True)
    cure = 'report v just before each y, or set estimator.use_applied_control: false'
    use, lag, limited_by = report_use(p), 0, 0.0
    if control is not None and applied is not None:
        apart = []
        for each in range(MORE_DELAY + 1):
            off = np.abs(applied[each:] - control[:len(control) - each])
            apart.append(off[np.isfinite(off)] if np.isfinite(off).any() else np.full(1, inf))
        lag = int(np.argmin([each.mean() for each in apart]))
        # What differs by more than 2 % of the swing was limited, but for 5 % of the samples.
        swing = float(np.nanmax(control) - np.nanmin(control))
        if np.mean(apart[lag] > 0.02 * swing) > 0.05:
            limited_by = float(apart[lag].max())
    if not heard.applied:
        verdict.check('applied_control', use is ReportUse.ALWAYS, 'is not published', cure)
        return lag
    share = len(heard.applied) / max(len(timing.outputs), 1)
    verdict.check('applied_control', use is not ReportUse.NEVER and share < REPORTED,
                  f'comes with {share:.0%} of the samples', cure)
    verdict.check(
        'applied_control', use is ReportUse.NEVER and limited_by,
        f'differs from control by up to {limited_by:.3g}',
        'set estimator.use_applied_control: true, or narrow control.min, max, rate_max',
        well='is published' if control is None else 'differs from control, as it may'
        if limited_by else 'agrees with control')
    return lag


def _judge_motion(
    verdict: Verdict, timing: Timing, acted: Array | None, lag: int, p: Parameters,
) -> None:
    """Judge what y does after the v that acted, by a fit of the whole record.

    lag: samples by which that v follows control.
    """
    if acted is None or np.nanmax(acted) == np.nanmin(acted):
        verdict.check('backlash', True, 'v stood still', 'run the controller, or check_driver '
                      '--drive', MOTION)
        return
    v, y = timing.record(acted)
    expected, noise_std = p.control.delay_samples, p.estimator.output_noise_std
    fit = _fitted(v, y, p, p.plant.denominator, range(expected + MORE_DELAY + 1))
    best = fit.fit
    if best is None:
        verdict.check('backlash', True, fit.doubts[0], 'let v swing wider than the gap, and for '
                      'longer: --duration; see that the driver applies v', MOTION)
        return
    unseen = f'not identifiable from this motion: v swung by {np.ptp(v):.4g}'
    # Without a turn of the play, lag and delay take up what the gap does.
    verdict.check('backlash', fit.reversals == 0 and fit.predicted >= WELL_PREDICTED,
                  f'{unseen} on one side', PAST, MOTION)
    # A report that counts already has the lag.
    delay = fit.delay + (0 if report_use(p) is ReportUse.ALWAYS else lag)
    another_delay = fit.margins.get(expected - delay + fit.delay, inf) > DECISIVE
    noisy = best.noise > 3.0 * noise_std  # by more than a guess may be off
    coloured = best.correlation > 0.5  # unlike the noise of a sensor
    # A delay that nobody announced together with what is not noise is an odd G as well.
    unlike = fit.predicted < WELL_PREDICTED or (noisy and coloured and another_delay)
    if (unlike or best.scale > 2.0) and 'G(z)' not in verdict.lines:
        other = _other_period(v, y, fit, p)
        verdict.check(
            'G(z)', other, f'is off by far, and less so for a sample period of {other:.3g} s',
            f'G(z) looks made for a sample period of about {other:.3g} s: discretise it with '
            f'sample_period, {p.sample_period:g} s', MOTION)
    predicted = f'predicts {fit.predicted:.1%} of the motion of y'
    if fit.model is not fit.nominal:  # the loop learns it too
        between = frequencies_of(y)
        predicted += ' once it is corrected: it is off by ' + ', '.join(
            f'{error:.1%} at {frequency / (2.0 * pi * p.sample_period):.2g} Hz'
            for frequency, error in zip(between, fit.error_of_model(between), strict=True))
    verdict.check(
        'G(z)', unlike, f'predicts {max(fit.predicted, 0.0):.0%} of the motion of y',
        'enter the G(z) of this plant, discretised with sample_period; see that y is measured '
        'behind the gap and that the driver holds v over the period', MOTION, predicted)
    verdict.check(
        'reaction delay', another_delay,
        f'{delay} samples; control.delay_samples says {expected}',
        f'apply v as soon as it comes, or set control.delay_samples: {delay}',
        well=f'{expected} samples, as control.delay_samples says')
    m = fit.estimates['m'][0]
    verdict.check('sign and units', fit.sign < 0.0, f'y moves against v: m would be {m:.4g}',
                  'change the sign of y or v in the driver, or of plant.numerator')
    outside = _outside(fit, p)
    verdict.check('sign and units', outside, outside, 'see the units of v, y and G(z) and the zero '
                  'of v, or widen estimator.bounds', well=f'm is about {m:.4g}, within its bounds')
    noise = f'deviation {best.noise:.2g}; estimator.output_noise_std says {noise_std:.2g}'
    verdict.check(
        'noise on y', noisy, noise, f'set estimator.output_noise_std: {best.noise:.1e}' + (
            ', or give a more exact G(z): the residual is coloured' if coloured else ''),
        well=noise)
    verdict.check(
        'backlash', fit.doubts, f'{unseen}; {"; ".join(fit.doubts)}', PAST, well=', '.join(
            f'{name} = {value:.4g} ± {std:.1g}' for name, (value, std) in fit.estimates.items()))


def _fitted(
    v: Array, y: Array, p: Parameters, denominator: Sequence[float], delays: range,
) -> RecordFit:
    return fit_record(v, y, TransferFunction(p.plant.numerator, denominator), p.plant.uncertainty,
                      p.estimator.output_noise_std, delays=delays)


def _outside(fit: RecordFit, p: Parameters) -> str:
    """Which estimate lies outside of its bounds; m alone counts while the others are not known."""
    for name, (value, std) in list(fit.estimates.items())[:1 if fit.doubts else 3]:
        low, high = getattr(p.estimator.bounds, name)
        slack = 3.0 * std + 0.01 * abs(value)
        if not low - slack <= value <= high + slack:
            return f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]'
    return ''


def _other_period(v: Array, y: Array, fit: RecordFit, p: Parameters) -> float:
    """Sample period [s] for which the poles of G fit better by far; 0 where there is none."""
    assert fit.fit is not None
    expected, evidence = p.control.delay_samples, fit.fit.evidence
    others: list[tuple[float, float, float]] = []
    for ratio in (0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 20.0):
        denominator = np.real(np.poly(fit.nominal.poles ** ratio)).tolist()
        # The same samples of y as in the fit, whose evidence is compared.
        refit = _fitted(
            v[MORE_DELAY:], y[MORE_DELAY:], p, denominator, range(expected, expected + 1))
        # The zeros are still those of the other period: G may be off by more, if it explains more.
        if refit.fit is not None and refit.predicted >= WELL_PREDICTED and (
                refit.fit.scale <= 1.0 or refit.fit.evidence > evidence + DECISIVE):
            others.append((refit.fit.evidence, refit.fit.scale, ratio))
    most = max((other[0] for other in others), default=-inf)
    if most <= evidence - DECISIVE:
        return 0.0
    # Of those that fit alike the one that is least off.
    return p.sample_period / min(other[1:] for other in others if other[0] > most - 10.0)[1]


def all_fit(judgements: Iterable[Judgement]) -> bool:
    """Whether nothing is wrong and nothing is left unknown."""
    return all(each.mark == FITS for each in judgements)


def table(judgements: Sequence[Judgement]) -> str:
    """A line per finding, the cure below what is wrong."""
    width = max(len(each.subject) for each in judgements)
    lines = []
    for each in judgements:
        lines.append(f'{each.mark} {each.subject.ljust(width)}  {each.found}')
        if each.cure:
            lines.append(f'  {" " * width}  → {each.cure}')
    return '\n'.join(lines)
