"""All that may be wrong with a driver, one table, and the verdict: each fault shows once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import pi
from typing import NamedTuple

from backlash_ros.core.driver_check.evidence import WELL_PREDICTED, Evidence
from backlash_ros.core.driver_check.heard import FEWEST_SAMPLES, MOST_LATE
from backlash_ros.core.loop.command_history import REPORTED, ReportUse, report_use
from backlash_ros.core.loop.diagnosis import SKEW, TROUBLE

FLOAT64 = 'std_msgs/msg/Float64'
FITS, WRONG, UNKNOWN = '✓', '✗', '–'

MOTION = ('reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash')
MESSAGES = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
ORDER = ('publisher', 'type', 'QoS', 'listener', *MESSAGES, 'applied_control', *MOTION)
# Amid jitter it is uncertain which v led to which y: what fits does, what does not may.
BLURRED_BY_JITTER = ('reaction delay', 'G(z)', 'noise on y')

Text = Callable[[Evidence], str]


class Judgement(NamedTuple):
    """A line of the verdict: what was looked at, whether it fits, what was found, what helps."""

    subject: str
    mark: str
    found: str
    cure: str = ''


class Fault(NamedTuple):
    """If `wrong` holds of a driver: what is said about the subject, what helps, and what cannot be
    judged then."""

    subject: str
    wrong: Callable[[Evidence], object]
    found: Text
    cure: str | Text
    hides: tuple[str, ...] = ()


def _qos(e: Evidence) -> str:
    deaf = e.graph.best_effort and not e.p.get('io.best_effort', False)
    reliable = ('plant_output is best effort, the controller asks for reliable',) if deaf else ()
    return '; '.join((*e.graph.misfits, *reliable))


def _use(e: Evidence) -> ReportUse:
    return report_use(e.p)


def _predicted(e: Evidence) -> str:
    """Say how far G is off where it was learned to be another one: the loop learns it too."""
    found = f'predicts {e.fit.predicted:.1%} of the motion of y'
    if e.fit.model is e.fit.nominal:
        return found
    return found + ' once it is corrected: it is off by ' + ', '.join(
        f'{error:.1%} at {frequency / (2.0 * pi * e.p.sample_period):.2g} Hz'
        for frequency, error in zip(
            e.fit.frequencies, e.fit.error_of_model(e.fit.frequencies), strict=True))


def _m(e: Evidence) -> float:
    return e.fit.estimates['m'][0]


# What is said of a subject where nothing is wrong; '' for nothing.
WELL: Mapping[str, Text] = {
    'publisher': lambda e: 'one publisher on plant_output',
    'QoS': lambda e: 'compatible',
    'listener': lambda e: 'control is subscribed',
    'rate': lambda e: f'{1.0 / e.timing.period_s:.4g} Hz, a sample every '
                      f'{e.timing.period_s * 1e3:.4g} ms',
    'jitter': lambda e: f'{e.timing.lateness:.0%} of a period (98 % of the samples)',
    'lost samples': lambda e: f'{e.timing.missing} of {e.timing.total} samples',
    'repeated samples': lambda e: 'none',
    'clock': lambda e: f'samples arrive {abs(e.age_s) * 1e3:.2g} ms '
                       f'{"before" if e.age_s < 0.0 else "after"} they left',
    'values': lambda e: 'all finite',
    'applied_control': lambda e: '' if not e.heard.applied else 'is published'
    if e.control is None else 'differs from control, as it may'
    if e.limited_by else 'agrees with control',
    'reaction delay':
        lambda e: f'{e.p.control.delay_samples} samples, as control.delay_samples says',
    'sign and units': lambda e: f'm is about {_m(e):.4g}, within its bounds',
    'G(z)': _predicted,
    'noise on y': lambda e: f'deviation {e.best.noise:.2g}; estimator.output_noise_std says '
                            f'{e.p.estimator.output_noise_std:.2g}',
    'backlash': lambda e: ', '.join(
        f'{name} = {value:.4g} ± {std:.1g}' for name, (value, std) in e.fit.estimates.items()),
}

REPORT = 'report v just before each y, or set estimator.use_applied_control: false'
PAST = 'swing v past the gap in both directions, several times; raise --duration'
UNSEEN = 'not identifiable from this motion: v swung by'

FAULTS = (
    Fault('publisher', lambda e: not e.graph.publishers,
          lambda e: 'nobody publishes plant_output', 'start the driver', ORDER),
    Fault('publisher', lambda e: e.graph.publishers > 1,
          lambda e: f'{e.graph.publishers} publishers on plant_output',
          'stop all but one (`ros2 topic info -v plant_output` names them)', (*MESSAGES, *MOTION)),
    Fault('type', lambda e: e.graph.types != (FLOAT64,),
          lambda e: f'plant_output is {", ".join(e.graph.types)}', f'publish y as {FLOAT64}',
          (*MESSAGES, *MOTION)),
    Fault('QoS', _qos, _qos,
          'use reliable, volatile, keep last (the default profile) on both topics'),
    Fault('listener', lambda e: not e.graph.listeners,
          lambda e: 'nobody listens to control' + (
              f', but somebody to {", ".join(e.graph.near_control)}'
              if e.graph.near_control else ''),
          f'let the driver subscribe control as {FLOAT64}, or remap it', MOTION),
    Fault('rate', lambda e: len(e.timing.outputs) < FEWEST_SAMPLES,
          lambda e: f'{len(e.heard.outputs)} samples heard, {FEWEST_SAMPLES} are needed',
          'see that plant_output is published without pause; raise --duration',
          (*MESSAGES, *MOTION)),
    Fault('rate', lambda e: not e.timing.fits,
          lambda e: f'{WELL["rate"](e)}; sample_period says {e.p.sample_period * 1e3:g} ms',
          'publish once per sample_period, or set sample_period to what the driver does and give '
          'G(z) for it', MOTION),
    Fault('jitter', lambda e: e.timing.lateness > MOST_LATE,
          WELL['jitter'],
          'publish from a timer with absolute deadlines; give the driver a real-time priority'),
    Fault('lost samples',
          lambda e: e.timing.missing > TROUBLE * e.timing.total, WELL['lost samples'],
          'publish every sample, reliable, without skipping any; on a network, use a cable'),
    Fault('repeated samples', lambda e: e.timing.repeated,
          lambda e: f'{e.timing.repeated} came twice',
          'publish each sample once: take out what doubles them, a second timer or a relay'),
    Fault('repeated samples', lambda e: e.timing.early > TROUBLE * len(e.timing.outputs),
          lambda e: f'{e.timing.early} came right after the one before',
          'let the timer of the driver leave out what it has missed instead of catching up'),
    Fault('repeated samples', lambda e: e.sensor_period,
          lambda e: f'y changes every {e.sensor_period * 1e3:.3g} ms only, and repeats between',
          'publish when the sensor has a new value; sample_period is that of the sensor'),
    Fault('clock', lambda e: abs(e.age_s) > SKEW * e.timing.period_s, WELL['clock'],
          'synchronise the clocks of both machines (chrony, PTP), or look for a slow network',
          MOTION),
    Fault('values', lambda e: e.implausible, lambda e: f'nan, inf or absurd: {e.implausible}',
          'publish nothing where the sensor has no value; the controller steps over it'),
    Fault('applied_control', lambda e: not e.heard.applied and _use(e) is ReportUse.ALWAYS,
          lambda e: 'is not published', REPORT),
    Fault('applied_control', lambda e: e.heard.applied and _use(e) is not ReportUse.NEVER
          and len(e.heard.applied) < REPORTED * len(e.timing.outputs),
          lambda e: f'comes with {len(e.heard.applied) / len(e.timing.outputs):.0%} of the samples',
          REPORT),
    Fault('applied_control', lambda e: _use(e) is ReportUse.NEVER and e.limited_by,
          lambda e: f'differs from control by up to {e.limited_by:.3g}',
          'set estimator.use_applied_control: true, or narrow control.min, max, rate_max'),
    Fault('backlash', lambda e: e.swing == 0.0, lambda e: 'v stood still',
          'run the controller, or check_driver --drive', MOTION),
    Fault('backlash', lambda e: e.fit.fit is None, lambda e: e.fit.doubts[0],
          'let v swing wider than the gap, and for longer: --duration; see that the driver applies '
          'v', MOTION),
    # Without a turn of the play, lag and delay take up what the gap does.
    Fault('backlash', lambda e: e.fit.reversals == 0 and e.fit.predicted >= WELL_PREDICTED,
          lambda e: f'{UNSEEN} {e.swing:.4g} on one side', PAST, MOTION),
    Fault('G(z)', lambda e: e.other_period,
          lambda e: f'is off by far, and less so for a sample period of {e.other_period:.3g} s',
          lambda e: f'G(z) looks made for a sample period of about {e.other_period:.3g} s: '
                    f'discretise it with sample_period, {e.p.sample_period:g} s', MOTION),
    Fault('G(z)', lambda e: e.unlike,
          lambda e: f'predicts {max(e.fit.predicted, 0.0):.0%} of the motion of y',
          'enter the G(z) of this plant, discretised with sample_period; see that y is measured '
          'behind the gap and that the driver holds v over the period', MOTION),
    Fault('reaction delay', lambda e: e.delay_is_another,
          lambda e: f'{e.delay} samples; control.delay_samples says {e.p.control.delay_samples}',
          lambda e: f'apply v as soon as it comes, or set control.delay_samples: {e.delay}'),
    Fault('sign and units', lambda e: e.fit.sign < 0.0,
          lambda e: f'y moves against v: m would be {_m(e):.4g}',
          'change the sign of y or v in the driver, or of plant.numerator'),
    Fault('sign and units', lambda e: e.outside, lambda e: e.outside,
          'see the units of v, y and G(z) and the zero of v, or widen estimator.bounds'),
    Fault('noise on y', lambda e: e.noisy, WELL['noise on y'],
          lambda e: f'set estimator.output_noise_std: {e.best.noise:.1e}' + (
              ', or give a more exact G(z): the residual is coloured' if e.coloured else '')),
    Fault('backlash', lambda e: e.fit.doubts,
          lambda e: f'{UNSEEN} {e.swing:.4g}; {"; ".join(e.fit.doubts)}', PAST),
)

def judge(e: Evidence) -> list[Judgement]:
    """All findings; what a fault hides is said to be unknown."""
    lines: dict[str, Judgement] = {}
    for subject, wrong, found, cure, hides in FAULTS:
        if subject in lines or not wrong(e):
            continue
        if subject in BLURRED_BY_JITTER and lines.get('jitter'):
            lines[subject] = _hidden(subject, 'jitter')
        else:
            lines[subject] = Judgement(
                subject, WRONG, found(e), cure if isinstance(cure, str) else cure(e))
        if hides is ORDER:
            break
        for other in hides:
            lines.setdefault(other, _hidden(other, subject))
    else:
        for subject, text in WELL.items():
            if subject not in lines and (words := text(e)):
                lines[subject] = Judgement(subject, FITS, words)
    return [lines[subject] for subject in ORDER if subject in lines]


def _hidden(subject: str, behind: str) -> Judgement:
    return Judgement(subject, UNKNOWN, f'can be told once {behind} fits')


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
