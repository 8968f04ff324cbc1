"""What the motion of a driver says: delay, sign, G(z), noise, and whether the backlash shows.

Pure: no ROS in here. The whole record is fitted at once, by the fit of the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isnan, nan, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check.findings import (
    FITS,
    UNKNOWN,
    WRONG,
    Finding,
    Heard,
    Message,
    Timing,
    finding,
    stamps_of,
)
from backlash_ros.core.driver_check.record_fit import RecordFit, fit_record
from backlash_ros.core.identification.verdict import SHOWS
from backlash_ros.core.loop.command_history import REPORTED, ReportUse, report_use, v_of_intervals
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

DELAY, SIGN, G_OF_Z, NOISE_ON_Y, SHOWN_BACKLASH = (
    'reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash',
)
MOTION_SUBJECTS = (DELAY, SIGN, G_OF_Z, NOISE_ON_Y, SHOWN_BACKLASH)

DECISIVE = 3.0  # log-likelihood by which one delay beats another
WELL_PREDICTED = 0.9  # share of the motion of y that G has to predict
OTHER_PERIODS = (0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 20.0)  # times T, tried for G
MORE_DELAY = 8  # samples that are tried beyond the expected delay


class DriverRecord(NamedTuple):
    """v (N,) from sample k to k+1, y (N,) with nan where lost, and what v was taken from.

    lag: samples from control to applied_control; 0 where v is that of control.
    """

    v: Array
    y: Array
    lag: int


def applied_findings(heard: Heard, timing: Timing, p: Parameters) -> list[Finding]:
    """Whether applied_control, where it is published or asked for, is of use."""
    report = 'report v just before each y, or set estimator.use_applied_control: false'
    subject, use = 'applied_control', report_use(p)
    if not heard.applied:
        return [Finding(subject, WRONG, 'is not published', report)] \
            if use is ReportUse.ALWAYS else []
    share = len(heard.applied) / len(timing.outputs)
    if use is not ReportUse.NEVER and share < REPORTED:
        return [Finding(subject, WRONG, f'comes with {share:.0%} of the samples', report)]
    applied, control = _on_grid(heard.applied, timing), _on_grid(heard.controls, timing)
    if use is not ReportUse.NEVER or control is None or applied is None:
        return [Finding(subject, FITS, 'is published')]
    moved = _shifted_difference(applied, control, _lag(applied, control))
    # What differs by more than 2 % of the swing was limited, but for 5 % of the samples.
    limited = np.mean(moved > 0.02 * np.ptp(control)) > 0.05
    return [finding(
        subject, not limited,
        f'differs from control by up to {moved.max():.3g}' if limited else 'agrees with control',
        'set estimator.use_applied_control: true, or narrow control.min, max, rate_max',
    )]


def record_of(heard: Heard, timing: Timing) -> DriverRecord | None:
    """v and y sample by sample, from the first known v on; None where no v was heard."""
    v = _on_grid(heard.applied or heard.controls, timing, reported=bool(heard.applied))
    if v is None:
        return None
    y = np.full(len(v), nan)
    y[timing.index] = [m.value if plausible(m.value) else nan for m in timing.outputs]
    control = _on_grid(heard.controls, timing) if heard.applied else None
    known = int(np.argmax(np.isfinite(v)))
    return DriverRecord(v[known:], y[known:], 0 if control is None else _lag(v, control))


def _on_grid(messages: list[Message], timing: Timing, reported: bool = False) -> Array | None:
    """v over each sample interval, shape (N,); nan before any. reported: it is that which acted."""
    usable = [message for message in messages if plausible(message.value)]
    if not usable:
        return None
    v = v_of_intervals(
        timing.index.astype(np.int64), stamps_of(timing.outputs), stamps_of(usable),
        np.array([message.value for message in usable]), reported,
    )
    return v if np.isfinite(v).any() else None


def _lag(applied: Array, control: Array) -> int:
    """Samples by which applied follows control."""
    return int(np.argmin([
        _shifted_difference(applied, control, lag).mean() for lag in range(MORE_DELAY + 1)
    ]))


def _shifted_difference(applied: Array, control: Array, lag: int) -> Array:
    difference = np.abs(applied[lag:] - control[: len(control) - lag])
    known = difference[np.isfinite(difference)]
    return known if len(known) else np.full(1, np.inf)


def motion_findings(record: DriverRecord | None, p: Parameters) -> list[Finding]:
    """What v and y say together."""
    coloured = 0.5  # correlation of successive residuals that noise of a sensor does not have
    noisier = 3.0  # times the given deviation of the noise
    swing = 0.0 if record is None else float(np.ptp(record.v))
    if record is None or swing == 0.0:
        return _only(SHOWN_BACKLASH, 'v stood still', 'run the controller, or check_driver --drive')
    fit = _fit(TransferFunction(p.plant.numerator, p.plant.denominator), record, p)
    past = 'swing v past the gap in both directions, several times; raise --duration'
    unseen = f'not identifiable from this motion: v swung by {swing:.4g}'
    # Without a turn of the play, lag and delay take up what the gap does.
    for hidden, found, cure in (
        (isnan(fit.evidence), f'too few samples after v had swung by {swing:.4g}',
         'raise --duration'),
        (fit.evidence < SHOWS, f'y shows nothing of v, which swung by {swing:.4g}',
         'let v swing wider than the gap; see that the driver applies v'),
        (fit.reversals == 0 and fit.predicted >= WELL_PREDICTED, f'{unseen} on one side', past),
    ):
        if hidden:
            return _only(SHOWN_BACKLASH, found, cure)
    noisy = fit.noise_std > noisier * p.estimator.output_noise_std
    delay = _delay(fit, record.lag, p)
    # A delay that nobody announced together with what is not noise is an odd G as well.
    odd = noisy and fit.correlation > coloured and delay.mark == WRONG
    unlike = fit.predicted < WELL_PREDICTED or odd
    if unlike or fit.error_scale > 2.0:
        other = _other_period(fit, record, p)
        if other is not None:
            return _only(
                G_OF_Z, f'is off by far, and less so for a sample period of {other:.3g} s',
                f'G(z) looks made for a sample period of about {other:.3g} s: discretise it with '
                f'sample_period, {p.sample_period:g} s')
        if unlike:
            return _only(
                G_OF_Z, f'predicts {max(fit.predicted, 0.0):.0%} of the motion of y',
                'enter the G(z) of this plant, discretised with sample_period; see that y is '
                'measured behind the gap and that the driver holds v over the period')
    return [
        delay, _sign(fit, p), _model(fit, p),
        finding(NOISE_ON_Y, not noisy, f'deviation {fit.noise_std:.2g}; estimator.output_noise_std '
                f'says {p.estimator.output_noise_std:.2g}',
                f'set estimator.output_noise_std: {fit.noise_std:.1e}' + (
                    ', or give a more exact G(z): the residual is coloured'
                    if fit.correlation > coloured else '')),
        finding(SHOWN_BACKLASH, not fit.doubts, f'{unseen}; {"; ".join(fit.doubts)}' if fit.doubts
                else ', '.join(f'{name} = {value:.4g} ± {std:.1g}'
                               for name, value, std in fit.estimates), past),
    ]


def _fit(
    model: TransferFunction, record: DriverRecord, p: Parameters, more_delay: int = MORE_DELAY,
) -> RecordFit:
    """Fit with any delay that the driver may have, or with the expected one alone."""
    expected = p.control.delay_samples
    return fit_record(
        record.v, record.y, model, p.plant.uncertainty, p.estimator.output_noise_std,
        delays=range(0 if more_delay else expected, expected + more_delay + 1),
    )


def _only(subject: str, found: str, cure: str) -> list[Finding]:
    """One reason why nothing else can be told."""
    return [Finding(subject, WRONG, found, cure), *not_judged(
        [other for other in MOTION_SUBJECTS if other != subject], subject)]


def not_judged(subjects: Sequence[str], behind: str) -> list[Finding]:
    """Lines for what something else hides."""
    return [Finding(subject, UNKNOWN, f'can be told once {behind} fits') for subject in subjects]


def _other_period(fit: RecordFit, record: DriverRecord, p: Parameters) -> float | None:
    """Sample period [s] for which the poles of G fit to within plant.uncertainty, or far better."""
    later = DriverRecord(record.v[MORE_DELAY:], record.y[MORE_DELAY:], record.lag)
    others: list[tuple[float, float, float]] = []
    for ratio in OTHER_PERIODS:
        denominator = np.real(np.poly(fit.nominal.poles.astype(complex) ** ratio)).tolist()
        # The same samples of y as in the fit, whose evidence is compared.
        refit = _fit(
            TransferFunction(fit.nominal.numerator.tolist(), denominator), later, p, more_delay=0)
        # The zeros are still those of the other period: G may be off by more, if it explains more.
        fits = refit.error_scale <= 1.0 or refit.evidence > fit.evidence + DECISIVE
        if refit.predicted >= WELL_PREDICTED and fits:
            others.append((refit.evidence, refit.error_scale, ratio))
    best = max((evidence for evidence, _, _ in others), default=-inf)
    if best <= fit.evidence - DECISIVE:
        return None
    # Of those that fit alike the one that is least off.
    _, ratio = min(other[1:] for other in others if other[0] > best - 10.0)
    return p.sample_period / ratio


def _delay(fit: RecordFit, lag: int, p: Parameters) -> Finding:
    expected = p.control.delay_samples
    if report_use(p) is ReportUse.ALWAYS:
        lag = 0  # the report already has it
    found, fits = fit.delay + lag, fit.margins.get(expected - lag, inf) <= DECISIVE
    return finding(
        DELAY, fits, f'{expected} samples, as control.delay_samples says' if fits
        else f'{found} samples; control.delay_samples says {expected}',
        f'apply v as soon as it comes, or set control.delay_samples: {found}')


def _sign(fit: RecordFit, p: Parameters) -> Finding:
    if fit.m < 0.0:
        return Finding(
            SIGN, WRONG, f'y moves against v: m would be {fit.m:.4g}',
            'change the sign of y or v in the driver, or of plant.numerator',
        )
    for name, value, std in fit.estimates[:1 if fit.doubts else 3]:
        low, high = getattr(p.estimator.bounds, name)
        slack = 3.0 * std + 0.01 * abs(value)
        if not low - slack <= value <= high + slack:
            return Finding(
                SIGN, WRONG, f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]',
                'see the units of v, y and G(z) and the zero of v, or widen '
                f'estimator.bounds.{name}',
            )
    return Finding(SIGN, FITS, f'm is about {fit.m:.4g}, within its bounds')


def _model(fit: RecordFit, p: Parameters) -> Finding:
    """Say how far G is off where it was learned to be another one: the loop learns it too."""
    found = f'predicts {fit.predicted:.1%} of the motion of y'
    if fit.model is not fit.nominal:
        found += ' once it is corrected: it is off by ' + ', '.join(
            f'{error:.1%} at {frequency / (2.0 * pi * p.sample_period):.2g} Hz'
            for frequency, error in zip(
                fit.frequencies, fit.error_of_model(fit.frequencies), strict=True)
        )
    return Finding(G_OF_Z, FITS, found)
