"""All that may be wrong with a driver, and the cure: its graph, its messages, its motion.

Each fault shows once. What a fault hides is not judged: amid lost samples nobody knows G(z).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import inf, pi
from typing import NamedTuple

import numpy as np

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

FLOAT64 = 'std_msgs/msg/Float64'
FITS, WRONG, UNKNOWN = '✓', '✗', '–'

MOTION = ('reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash')
MESSAGES = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
ORDER = ('publisher', 'type', 'QoS', 'listener', *MESSAGES, 'applied_control', *MOTION)

MORE_DELAY = 8  # samples that are tried beyond the expected delay


class Judgement(NamedTuple):
    """A line of the verdict: what was looked at, whether it fits, what was found, what helps."""

    subject: str
    mark: str
    found: str
    cure: str = ''


class Row(NamedTuple):
    """What is told of a subject if it is wrong, and with which cure; `well` if nothing is.

    hides: subjects that cannot be judged then. well: '' while more is to be checked.
    """

    subject: str
    wrong: object
    found: str
    cure: str
    hides: Sequence[str] = ()
    well: str = ''


def judge(graph: Graph, heard: Heard, p: Parameters) -> list[Judgement]:
    """All findings on a driver; p: parameters of the controller. Of a subject the first counts."""
    if not graph.publishers:
        return [Judgement('publisher', WRONG, 'nobody publishes plant_output', 'start the driver')]
    lines: dict[str, Judgement] = {}
    timing = timing_of(heard, p.sample_period)
    lag, limited_by = _report_behind_command(heard, timing)
    for needed, rows in (('', _of_graph(graph, p)), ('rate', _of_messages(heard, timing, p)),
                         ('', _of_reports(heard, timing, limited_by, p)),
                         ('backlash', _of_motion(heard, timing, lag, p))):
        for row in rows if needed not in lines else ():
            _take(row, lines)
    return [lines[subject] for subject in ORDER if subject in lines]


def _take(row: Row, lines: dict[str, Judgement]) -> None:
    if row.wrong and row.subject not in lines:
        # Amid jitter it is uncertain which v led to which y: what does not fit may do so.
        blurred = row.subject in ('reaction delay', 'G(z)', 'noise on y') and \
            'jitter' in lines and lines['jitter'].mark == WRONG
        lines[row.subject] = _hidden(row.subject, 'jitter') if blurred else \
            Judgement(row.subject, WRONG, row.found, row.cure)
        for other in row.hides:
            lines.setdefault(other, _hidden(other, row.subject))
    elif row.well:
        lines.setdefault(row.subject, Judgement(row.subject, FITS, row.well))


def _hidden(subject: str, behind: str) -> Judgement:
    return Judgement(subject, UNKNOWN, f'can be told once {behind} fits')


def _of_graph(graph: Graph, p: Parameters) -> Iterator[Row]:
    yield Row('publisher', graph.publishers > 1, f'{graph.publishers} publishers on plant_output',
              'stop all but one (`ros2 topic info -v plant_output` names them)',
              (*MESSAGES, *MOTION), 'one publisher on plant_output')
    yield Row('type', graph.types != (FLOAT64,), f'plant_output is {", ".join(graph.types)}',
              f'publish y as {FLOAT64}', (*MESSAGES, *MOTION))
    deaf = graph.best_effort and not p['io.best_effort']
    misfits = (*graph.misfits, *[
        'plant_output is best effort, the controller asks for reliable'] * deaf)
    yield Row('QoS', misfits, '; '.join(misfits), 'use reliable, volatile, keep last (the default '
              'profile) on both topics', well='compatible')
    near = f', but somebody to {", ".join(graph.near_control)}' if graph.near_control else ''
    yield Row('listener', not graph.listeners, f'nobody listens to control{near}',
              f'let the driver subscribe control as {FLOAT64}, or remap it', MOTION,
              'control is subscribed')


def _of_messages(heard: Heard, timing: Timing, p: Parameters) -> Iterator[Row]:
    count, period = len(timing.outputs), timing.period_s
    yield Row('rate', count < FEWEST_SAMPLES, f'{len(heard.outputs)} samples heard, '
              f'{FEWEST_SAMPLES} are needed', 'see that plant_output is published without pause; '
              'raise --duration', (*MESSAGES, *MOTION))
    if count < FEWEST_SAMPLES:
        return
    rate = f'{1.0 / period:.4g} Hz, a sample every {period * 1e3:.4g} ms'
    yield Row('rate', not timing.fits, f'{rate}; sample_period says {p.sample_period * 1e3:g} ms',
              'publish once per sample_period, or set sample_period to what the driver does and '
              'give G(z) for it', MOTION, rate)
    jitter = f'{timing.lateness:.0%} of a period (98 % of the samples)'
    yield Row('jitter', timing.lateness > MOST_LATE, jitter, 'publish from a timer with absolute '
              'deadlines; give the driver a real-time priority', well=jitter)
    lost = f'{timing.missing} of {count + timing.missing} samples'
    yield Row('lost samples', timing.missing > TROUBLE * (count + timing.missing), lost, 'publish '
              'every sample, reliable, without skipping any; on a network, use a cable', well=lost)
    yield Row('repeated samples', timing.repeated, f'{timing.repeated} came twice', 'publish each '
              'sample once: take out what doubles them, a second timer or a relay')
    yield Row('repeated samples', timing.early > TROUBLE * count, f'{timing.early} came right '
              'after the one before', 'let the timer of the driver leave out what it has missed '
              'instead of catching up')
    y = np.array([message.value for message in timing.outputs])
    _, slower_s = own_readings(period * timing.numbers.astype(float), y)
    yield Row('repeated samples', slower_s, f'y changes every {slower_s * 1e3:.3g} ms only, and '
              'repeats between', 'publish when the sensor has a new value; sample_period is that '
              'of the sensor', well='none')
    age_s = 1e-9 * float(np.median([m.received_ns - m.stamp_ns for m in timing.outputs]))
    age = f'samples arrive {abs(age_s) * 1e3:.2g} ms {"before" if age_s < 0.0 else "after"} they ' \
          'left'
    yield Row('clock', abs(age_s) > SKEW * period, age, 'synchronise the clocks of both machines '
              '(chrony, PTP), or look for a slow network', MOTION, age)
    counts = {topic: sum(not plausible(message.value) for message in messages)
              for topic, messages in heard.by_topic.items()}
    absurd = ', '.join(f'{count} on {topic}' for topic, count in counts.items() if count)
    yield Row('values', absurd, f'nan, inf or absurd: {absurd}', 'publish nothing where the sensor '
              'has no value; the controller steps over it', well='all finite')


def _report_behind_command(heard: Heard, timing: Timing) -> tuple[int, float]:
    """Samples by which applied_control follows control, and by how much it is limited, 0: not."""
    control, applied = timing.v_of(heard.controls, False), timing.v_of(heard.applied, True)
    if control is None or applied is None:
        return 0, 0.0
    off = [np.abs(applied[lag:] - control[:len(control) - lag]) for lag in range(MORE_DELAY + 1)]
    off = [each[np.isfinite(each)] for each in off]
    lag = int(np.argmin([each.mean() if len(each) else inf for each in off]))
    # What differs by more than 2 % of the swing was limited, but for 5 % of the samples.
    swing = float(np.nanmax(control) - np.nanmin(control))
    limited = len(off[lag]) and np.mean(off[lag] > 0.02 * swing) > 0.05
    return lag, float(off[lag].max()) if limited else 0.0


def _of_reports(
    heard: Heard, timing: Timing, limited_by: float, p: Parameters,
) -> Iterator[Row]:
    cure = 'report v just before each y, or set estimator.use_applied_control: false'
    use, share = report_use(p), len(heard.applied) / max(len(timing.outputs), 1)
    if not heard.applied:
        yield Row('applied_control', use is ReportUse.ALWAYS, 'is not published', cure)
        return
    yield Row('applied_control', use is not ReportUse.NEVER and share < REPORTED,
              f'comes with {share:.0%} of the samples', cure)
    yield Row('applied_control', use is ReportUse.NEVER and limited_by,
              f'differs from control by up to {limited_by:.3g}',
              'set estimator.use_applied_control: true, or narrow control.min, max, rate_max',
              well='is published' if not heard.controls else 'differs from control, as it may'
              if limited_by else 'agrees with control')


def _of_motion(heard: Heard, timing: Timing, lag: int, p: Parameters) -> Iterator[Row]:
    """What y does after the v that acted, by a fit of the whole record.

    lag: samples by which that v follows control.
    """
    record, noise_std = timing.record(heard), p.estimator.output_noise_std
    if record is None or np.ptp(record[0]) == 0.0:
        yield Row('backlash', True, 'v stood still', 'run the controller, or check_driver --drive',
                  MOTION)
        return
    (v, y), expected = record, p.control.delay_samples
    fit = fit_record(v, y, TransferFunction(p.plant.numerator, p.plant.denominator),
                     p.plant.uncertainty, noise_std, delays=range(expected + MORE_DELAY + 1))
    best = fit.fit
    if best is None:
        yield Row('backlash', True, fit.doubts[0], 'let v swing wider than the gap, and for '
                  'longer: --duration; see that the driver applies v', MOTION)
        return
    past = 'swing v past the gap in both directions, several times; raise --duration'
    unseen = f'not identifiable from this motion: v swung by {np.ptp(v):.4g}'
    # Without a turn of the play, lag and delay take up what the gap does.
    explained = fit.predicted >= 0.9  # of the motion of y
    yield Row('backlash', fit.reversals == 0 and explained, f'{unseen} on one side', past, MOTION)
    # A report that counts already has the lag.
    delay = fit.delay + (0 if report_use(p) is ReportUse.ALWAYS else lag)
    decisive = 3.0  # log-likelihood by which one delay beats another
    another_delay = fit.margins.get(expected - delay + fit.delay, inf) > decisive
    noisy = best.noise > 3.0 * noise_std  # by more than a guess may be off
    coloured = best.left.correlation > 0.5  # unlike the noise of a sensor
    predicted = f'predicts {max(fit.predicted, 0.0):.1%} of the motion of y'
    between, corrected = frequencies_of(y), ''
    if fit.model is not fit.nominal:  # the loop learns it too
        corrected = ' once it is corrected: it is off by ' + ', '.join(
            f'{error:.1%} at {frequency / (2.0 * pi * p.sample_period):.2g} Hz'
            for frequency, error in zip(between, fit.error_of_model(between), strict=True))
    # A delay that nobody announced together with what is not noise is an odd G as well.
    yield Row('G(z)', not explained or (noisy and coloured and another_delay), predicted,
              'enter the G(z) of this plant, discretised with sample_period; see that y is '
              'measured behind the gap and that the driver holds v over the period', MOTION)
    yield Row('G(z)', best.scale > 2.0, f'{predicted}{corrected}, by more than twice what '
              f'plant.uncertainty, {p.plant.uncertainty:g}, says', 'see that it is discretised '
              'with sample_period, or raise plant.uncertainty', well=predicted + corrected)
    yield Row('reaction delay', another_delay,
              f'{delay} samples; control.delay_samples says {expected}',
              f'apply v as soon as it comes, or set control.delay_samples: {delay}',
              well=f'{expected} samples, as control.delay_samples says')
    m = fit.estimates['m'][0]
    yield Row('sign and units', fit.sign < 0.0, f'y moves against v: m would be {m:.4g}',
              'change the sign of y or v in the driver, or of plant.numerator')
    outside = _outside(fit, p)
    yield Row('sign and units', outside, outside, 'see the units of v, y and G(z) and the zero of '
              'v, or widen estimator.bounds', well=f'm is about {m:.4g}, within its bounds')
    noise = f'deviation {best.noise:.2g}; estimator.output_noise_std says {noise_std:.2g}'
    yield Row('noise on y', noisy, noise, f'set estimator.output_noise_std: {best.noise:.1e}' + (
        ', or give a more exact G(z): the residual is coloured' if coloured else ''), well=noise)
    yield Row('backlash', fit.doubts, f'{unseen}; {"; ".join(fit.doubts)}', past, well=', '.join(
        f'{name} = {value:.4g} ± {std:.1g}' for name, (value, std) in fit.estimates.items()))


def _outside(fit: RecordFit, p: Parameters) -> str:
    """Which estimate lies outside of its bounds; m alone counts while the others are not known."""
    for name, (value, std) in list(fit.estimates.items())[:1 if fit.doubts else 3]:
        low, high = getattr(p.estimator.bounds, name)
        slack = 3.0 * std + 0.01 * abs(value)
        if not low - slack <= value <= high + slack:
            return f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]'
    return ''


def all_fit(judgements: Iterable[Judgement]) -> bool:
    """Whether nothing is wrong and nothing is left unknown."""
    return all(each.mark == FITS for each in judgements)


def table(judgements: Sequence[Judgement]) -> str:
    """A line per finding, the cure below what is wrong."""
    width = max(len(each.subject) for each in judgements)
    return '\n'.join(
        f'{each.mark} {each.subject.ljust(width)}  {each.found}'
        + (f'\n  {" " * width}  → {each.cure}' if each.cure else '') for each in judgements)
